"""Agents learn from pixels what is right in tasks whose answer is known.

What is wrong in an agent shows in the task that is about it: a value that does not fit, a
discount, a credit that goes astray, a time limit taken for an end, a gradient of wrong sign.
"""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import PixelEnv, VectorPixelEnv
from pixelbrax_jax.agents.networks.actor_critic import Actor, Critic
from pixelbrax_jax.agents.on_policy.dcpg import DCPG, DCPGConfig
from pixelbrax_jax.agents.on_policy.ppg import PPG, PPGConfig
from pixelbrax_jax.agents.on_policy.ppo import PPO, PPOConfig
from pixelbrax_jax.config import EnvConfig
from tests.agents.probes import NAMES, TARGETS, TIME_LIMIT, Probes, true_values
from tests.envs.toy import limited
from tests.xla_flags import optimized

GAMMA = 0.7
PARAMS = limited(TIME_LIMIT)
OPTIONS = {"height": 18, "width": 18, "frame_stack": 1}
SHARED = {
    "env": EnvConfig(**OPTIONS, episode_length=TIME_LIMIT),
    "encoder": "small",
    "num_envs": 16,
    "num_steps": 8,
    "num_minibatches": 2,
    "gamma": GAMMA,
    "initial_std": 0.5,
    "learning_rate": 3e-3,
    # What remains of the noise of single minibatches goes with the step size.
    "anneal": True,
    "total_steps": 16 * 8 * 60,
    "normalize_reward": False,
}
PHASIC = {"num_policy_phases": 2, "aux_minibatches": 4, "aux_epochs": 4}

AGENTS = {
    "ppo": (PPO, PPOConfig(**SHARED, update_epochs=4)),
    "ppg": (PPG, PPGConfig(**SHARED, **PHASIC, policy_epochs=2, value_epochs=2)),
    "dcpg": (DCPG, DCPGConfig(**SHARED, **PHASIC, update_epochs=2)),
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


@pytest.fixture(scope="module", params=AGENTS)
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
    if "critic" in state.networks:
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
