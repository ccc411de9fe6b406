"""Tasks so simple that what an agent must find out is known, all in one environment.

The ball lies in one of ten places, and each place is a situation of some small task. An image
tells the place, and the place tells the future. An episode begins in a random task.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax import Physics, PhysicsState
from tests.envs.toy import GEOMS

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
