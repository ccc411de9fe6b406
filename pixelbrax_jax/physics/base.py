"""The interface between physics and the rest of the package."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import jax
from flax import struct

from pixelbrax_jax.types import Geoms, PhysicsState


class Kinematics(struct.PyTreeNode):
    """The readable part of a simulator's state; what task formulas are written in.

    Attributes:
        q: (Q,) float32, joint positions in MuJoCo's order (metres, radians; a free joint is a
            position and a quaternion).
        qd: (V,) float32, joint velocities in MuJoCo's order, per second.
        xpos: (L, 3) float32, metres, link origins in the world frame.
        xquat: (L, 4) float32, unit, link orientations in the world frame.
    """

    q: jax.Array
    qd: jax.Array
    xpos: jax.Array
    xquat: jax.Array


RewardFn = Callable[[Kinematics, Kinematics, jax.Array], jax.Array]
"""A reward of the states before and after a step and the (A,) action; returns a scalar."""

ResetFn = Callable[[jax.Array], tuple[jax.Array, jax.Array]]
"""Of a PRNG key; returns joint positions (Q,) and velocities (V,), as in ``Kinematics``."""


@runtime_checkable
class Physics(Protocol):
    """A task's dynamics for ONE environment, as pure functions.

    ``reset`` and ``step`` may be jitted, vmapped and scanned; every state they return has the
    same tree, shapes and dtypes, so a jitted ``step`` is traced once. The fields of a
    ``PhysicsState`` other than ``engine`` are always finite, as ``divergence.GuardedPhysics`` sees
    to. Environments over equal physics share compiled programs; it must hence be hashable, and
    equal only to what computes the same.

    An engine may have more attributes: ``rigs``, cameras by name, of which ``default`` is the
    task's own if it is there; ``unfit_cameras``, by name why other cameras of the model cannot be
    rigs; ``followed_link``, the link that a camera follows if nothing else is said, 0 by default;
    ``look``, the lights, sky and ground of its model; ``from_qpos``, a function of joint positions,
    velocities and a key that returns the first state of an episode; ``batch_last``, False where a
    CPU computes a batch faster with the environments as first axis; and ``compiler_options``, which
    XLA needs on a CPU to make its programs fast.

    Attributes:
        geoms: the visible shapes, each fixed in a link's frame.
        dt: seconds of simulated time per control step.
        action_size: A, number of actuators.
        state_size: S, length of ``PhysicsState.obs``.
        backend: name of the physics backend.
        link_names: L names; ``link/index`` where the model has none. Row i of ``xpos`` and
            ``xquat`` belongs to ``link_names[i]``.
    """

    geoms: Geoms
    dt: float
    action_size: int
    state_size: int
    backend: str
    link_names: tuple[str, ...]

    def reset(self, key: jax.Array) -> PhysicsState:
        """Sample the task's initial state.

        Args:
            key: PRNG key, the only source of randomness.

        Returns:
            The first state of an episode, with reward 0 and ``terminated`` false. Should the
            sample itself be non-finite, ``non_finite`` and ``terminated`` are true, the links
            are at the world's origin and the observation is 0.
        """
        ...

    def step(self, state: PhysicsState, action: jax.Array) -> PhysicsState:
        """Advance by one control step.

        Args:
            state: what ``reset`` or ``step`` returned.
            action: (A,) float32. Tasks are written for [-1, 1]; the caller clips.

        Returns:
            The next state. If the step diverged (see ``PhysicsState.non_finite``) it is the
            given state with reward 0 and ``terminated`` and ``non_finite`` true. Stepping on
            after a termination is allowed and continues the dynamics.
        """
        ...
