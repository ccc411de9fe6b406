"""Agents learn from pixels what is right in tasks whose answer is known.

What is wrong in an agent shows in the task that is about it: a value that does not fit, a
discount, a credit that goes astray, a time limit taken for an end, a gradient of wrong sign.
All tasks are in one environment. The ball lies in one of ten places, and each place is a situation
of some task. An image tells the place, and the place tells the future.
"""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import Physics, PhysicsState, PixelEnv, VectorPixelEnv
from pixelbrax_jax.agents.networks.actor_critic import Actor, Critic
from pixelbrax_jax.agents.off_policy.config import DrQv2Config
from pixelbrax_jax.agents.off_policy.drqv2 import DrQv2
from pixelbrax_jax.agents.on_policy.dcpg import DCPG, DCPGConfig
from pixelbrax_jax.agents.on_policy.ppg import PPG, PPGConfig
from pixelbrax_jax.agents.on_policy.ppo import PPO, PPOConfig
from pixelbrax_jax.config import EnvConfig
from tests.envs.toy import GEOMS, limited
from tests.xla_flags import optimized

TIME_LIMIT = 2
"""Steps of an episode at most."""

PLACES = {
    # name: (reward, whether the task ends, the next place)
    "constant": (1.0, True, "constant"),
    "early": (0.0, False, "late"),
    "late": (1.0, True, "late"),
    "good": (2.0, True, "good"),
    "bad": (-1.0, True, "bad"),
    # The time limit ends this one, not the task.
    "endless": (1.0, False, "endless"),
    "two left": (1.0, False, "one left"),
    "one left": (1.0, True, "one left"),
    # The reward is 1 less the squared distance of the action from a target.
    "go left": (0.0, True, "go left"),
    "go right": (0.0, True, "go right"),
}
NAMES = tuple(PLACES)
TARGETS = {"go left": -0.5, "go right": 0.5}

_REWARD = np.array([reward for reward, _, _ in PLACES.values()], np.float32)
_ENDS = np.array([ends for _, ends, _ in PLACES.values()])
_NEXT = np.array([NAMES.index(following) for _, _, following in PLACES.values()])
_TARGET = np.array([TARGETS.get(name, np.nan) for name in NAMES], np.float32)
_STARTS = np.array([i for i, name in enumerate(NAMES) if name not in ("late", "one left")])
_XZ = np.array([[x, z] for z in (0.0, 0.9) for x in (-1.5, -0.75, 0.0, 0.75, 1.5)], np.float32)


def true_values(gamma: float) -> dict[str, float]:
    """What each place is worth, for every policy; not of those where the action matters."""
    return {
        "constant": 1.0,
        "early": gamma,
        "late": 1.0,
        "good": 2.0,
        "bad": -1.0,
        "endless": 1.0 / (1.0 - gamma),
        "two left": 1.0 + gamma,
        "one left": 1.0,
    }


class Probes(Physics):
    """All tasks. The engine's state is the index of the place."""

    geoms = GEOMS
    dt = 0.1
    action_size = 1
    state_size = 1
    backend = "toy"
    link_names = ("ball",)

    def reset(self, key: jax.Array) -> PhysicsState:
        return self.at(jax.random.choice(key, _STARTS))

    def step(self, state: PhysicsState, action: jax.Array) -> PhysicsState:
        place = state.engine
        target = jnp.asarray(_TARGET)[place]
        depends = 1.0 - (action[0] - target) ** 2
        reward = jnp.where(jnp.isnan(target), jnp.asarray(_REWARD)[place], depends)
        following = self.at(jnp.asarray(_NEXT)[place])
        return following.replace(reward=reward, terminated=jnp.asarray(_ENDS)[place])

    @staticmethod
    def at(place: jax.Array) -> PhysicsState:
        """An episode's first state, with the ball in the given place."""
        x, z = jnp.asarray(_XZ)[place]
        return PhysicsState(
            engine=jnp.int32(place),
            xpos=jnp.stack([x, 0.0 * x, z])[None],
            xquat=jnp.array([[1.0, 0.0, 0.0, 0.0]]),
            obs=place[None].astype(jnp.float32),
            reward=jnp.float32(0.0),
            terminated=jnp.bool_(False),
            non_finite=jnp.bool_(False),
        )


GAMMA = 0.7
PARAMS = limited(TIME_LIMIT)
OPTIONS = {"height": 18, "width": 18, "frame_stack": 1}
SHARED = {
    "env": EnvConfig(**OPTIONS, episode_length=TIME_LIMIT),
    "encoder": "small",
    "num_envs": 16,
    "num_steps": 8,
    "gamma": GAMMA,
    "learning_rate": 3e-3,
    # What remains of the noise of single minibatches goes with the step size.
    "anneal": True,
    "total_steps": 16 * 8 * 60,
}
ON_POLICY = SHARED | {"num_minibatches": 2, "initial_std": 0.5, "normalize_reward": False}
REPLAY = {
    "replay_ratio": 0.125,
    "buffer_size": 4096,
    "learning_starts": 512,
    "batch_size": 64,
    "n_step": 2,
    "random_shift": 0,
    "tau": 0.1,
    "feature_dim": 32,
    "hidden_dim": 64,
    "std_steps": 4096,
}
PHASIC = {"num_policy_phases": 2, "aux_minibatches": 4, "aux_epochs": 4}

AGENTS = {
    "ppo": (PPO, PPOConfig(**ON_POLICY, update_epochs=4)),
    "ppg": (PPG, PPGConfig(**ON_POLICY, **PHASIC, policy_epochs=2, value_epochs=2)),
    "dcpg": (DCPG, DCPGConfig(**ON_POLICY, **PHASIC, update_epochs=2)),
    "drqv2": (DrQv2, DrQv2Config(**SHARED, **REPLAY)),
    "c51": (
        DrQv2,
        DrQv2Config(
            **SHARED, **REPLAY, critic="c51", v_min=-2.0, v_max=5.0, num_atoms=29, policy_delay=2
        ),
    ),
}


@pytest.fixture(scope="module")
def envs():
    return VectorPixelEnv(PixelEnv(Probes(), **OPTIONS), SHARED["num_envs"])


@pytest.fixture(scope="module")
def images(envs):
    """What an agent sees in each place."""

    @jax.jit
    @jax.vmap
    def image(place):
        state = envs.env.reset_sim(jax.random.key(0), jnp.uint32(0), PARAMS)
        state = state.replace(physics=Probes.at(place))
        return envs.env.push_frame(envs.env.blank_frames(), state, jnp.bool_(True), PARAMS)

    return image(jnp.arange(len(NAMES)))


def values_of(algorithm, networks, images):
    """The mean of both Q functions at the best action."""
    module = algorithm.modules
    features = module["encoder"].apply(networks["encoder"], images)
    action = jnp.tanh(module["actor"].apply(networks["actor"], features))
    outputs = module["critic"].apply(networks["critic"], features, action)
    return algorithm.values(outputs).mean(0)


# Phasic agents and C51 learn by what the others learn by.
FEW = ("ppo", "drqv2")
LEARNERS = [pytest.param(n, marks=() if n in FEW else pytest.mark.slow) for n in AGENTS]


@pytest.fixture(scope="module", params=LEARNERS)
def learned(request, envs, images):
    """Values and mean actions by place, of an agent that has learned."""
    make, config = AGENTS[request.param]
    algorithm = make(config, envs)
    number = algorithm.auxiliary_every or 2

    @partial(jax.jit, compiler_options=optimized())
    def phase(state):
        state, _ = jax.lax.scan(
            lambda state, _: algorithm.iterate(state, PARAMS), state, length=number
        )
        return algorithm.auxiliary(state)[0] if algorithm.auxiliary_every else state

    state = algorithm.init(jax.random.key(0), PARAMS)
    for _ in range(config.num_iterations // number):
        state = phase(state)
    if isinstance(algorithm, DrQv2):
        values = values_of(algorithm, state.networks, images)
    elif "critic" in state.networks:
        values = Critic("small").apply(state.networks["critic"], images)
    else:
        actor = Actor("small", 1, config.policy, has_value=True)
        values = actor.apply(state.networks["actor"], images).value
    actions = algorithm.act(state.networks, images)[:, 0]
    return SimpleNamespace(
        value=dict(zip(NAMES, np.asarray(values).tolist(), strict=True)),
        action=dict(zip(NAMES, np.asarray(actions).tolist(), strict=True)),
    )


def test_places_can_be_told_apart(images):
    assert len({np.asarray(image).tobytes() for image in images}) == len(NAMES)


@pytest.mark.parametrize("place", true_values(GAMMA))
def test_a_place_is_worth_what_it_is(learned, place):
    assert learned.value[place] == pytest.approx(true_values(GAMMA)[place], abs=0.08)


@pytest.mark.parametrize("place", TARGETS)
def test_the_mean_action_is_the_best_one(learned, place):
    assert learned.action[place] == pytest.approx(TARGETS[place], abs=0.25)


class Memory(Probes):
    """A place on the left or right, then one in the middle, rewarded 1 or -1 by the first."""

    def reset(self, key: jax.Array) -> PhysicsState:
        return self.at(jax.random.randint(key, (), 0, 2))

    def step(self, state: PhysicsState, action: jax.Array) -> PhysicsState:
        del action
        place = state.engine
        following = self.at(jnp.minimum(place + 2, 3))
        reward = jnp.array([0.0, 0.0, 1.0, -1.0])[place]
        return following.replace(reward=reward, terminated=place > 1)

    @staticmethod
    def at(place: jax.Array) -> PhysicsState:
        first = Probes.at(jnp.array([1, 3, 7, 7])[place])
        return first.replace(engine=jnp.int32(place))


@pytest.mark.slow
def test_a_stack_tells_what_the_second_newest_frame_shows():
    settings = SHARED | REPLAY | {"total_steps": 16 * 8 * 40}
    config = DrQv2Config(**settings).replace(frame_stack=2, episode_length=5)
    params, options = limited(5), OPTIONS | {"frame_stack": 2}
    env = PixelEnv(Memory(), **options)
    algorithm = DrQv2(config, VectorPixelEnv(env, config.num_envs))

    @partial(jax.jit, compiler_options=optimized())
    def iterate(state):
        return algorithm.iterate(state, params)[0]

    state = algorithm.init(jax.random.key(0), params)
    for _ in range(config.num_iterations):
        state = iterate(state)

    @jax.jit
    @jax.vmap
    def stack(place):
        sim = env.reset_sim(jax.random.key(0), jnp.uint32(0), params)
        frames = env.blank_frames()
        for number, now in enumerate((place, place + 2)):
            seen = sim.replace(physics=Memory.at(now))
            frames = env.push_frame(frames, seen, jnp.bool_(number == 0), params)
        return frames

    pixels = stack(jnp.arange(2))
    assert np.array_equal(pixels[0, ..., 3:], pixels[1, ..., 3:]), "the newest frames are alike"
    values = values_of(algorithm, state.networks, pixels)
    np.testing.assert_allclose(values, [1.0, -1.0], atol=0.1)
