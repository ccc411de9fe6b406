"""A task so small that it compiles in a moment: a ball pushed along a line."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax import EnvParams, GeomKind, Geoms, Physics, PhysicsState, make_look, make_rig

GEOMS = Geoms(
    kind=(int(GeomKind.PLANE), int(GeomKind.SPHERE)),
    link=(-1, 0),
    material=(0, 1),
    name=("ground", "ball"),
    size=np.array([[0, 0, 1], [0.3, 0, 0]], np.float32),
    pos=np.array([[0, 0, -0.3], [0, 0, 0]], np.float32),
    quat=np.array([[1, 0, 0, 0], [1, 0, 0, 0]], np.float32),
    rgb=np.array([[0.5, 0.5, 0.5], [0.9, 0.3, 0.1]], np.float32),
)
PARAMS = EnvParams(
    geoms=GEOMS, rig=make_rig((0.0, -4.0, 1.0), (0.0, 0.0, 0.0), 50.0), look=make_look("default")
)


def limited(episode_length: int) -> EnvParams:
    """``PARAMS`` with another time limit."""
    return PARAMS.replace(episode_length=np.int32(episode_length))


class Ball(Physics):
    """The action is the ball's velocity; beyond x = 1 the task ends. NaN actions diverge.

    The reward is the new position, the state observation the position and the count of steps.
    """

    geoms = GEOMS
    dt = 0.1
    action_size = 1
    state_size = 2
    backend = "toy"
    link_names = ("ball",)

    # Environments over equal balls share programs.

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and vars(self) == vars(other)

    def __hash__(self) -> int:
        return hash(type(self))

    def reset(self, key: jax.Array) -> PhysicsState:
        x = jax.random.uniform(key, minval=-0.5, maxval=0.0)
        return self._state(x, jnp.float32(0.0), jnp.float32(0.0), jnp.bool_(False))

    def step(self, state: PhysicsState, action: jax.Array) -> PhysicsState:
        x, count, _ = state.engine
        moved = x + self.dt * action[0]
        bad = ~jnp.isfinite(moved)
        moved = jnp.where(bad, x, moved)
        return self._state(moved, count + 1, jnp.where(bad, 0.0, moved), bad)

    @staticmethod
    def _state(x, count, reward, bad) -> PhysicsState:
        return PhysicsState(
            # Engines may carry empty arrays, as MJX does.
            engine=(x, count, jnp.zeros((0, 3))),
            xpos=jnp.stack([x, 0.0 * x, 0.0 * x])[None],
            xquat=jnp.array([[1.0, 0.0, 0.0, 0.0]]),
            obs=jnp.stack([x, count]),
            reward=reward,
            terminated=(x > 1.0) | bad,
            non_finite=bad,
        )
