"""What physics is to the rest of the package: the base class of every engine."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import jax
from flax import struct

from pixelbrax_jax.types import CameraRig, Geoms, Look, PhysicsState


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


class Physics(abc.ABC):
    """A task's dynamics for ONE environment, as pure functions.

    ``reset`` and ``step`` may be jitted, vmapped and scanned; every state they return has the
    same tree, shapes and dtypes, so a jitted ``step`` is traced once. The fields of a
    ``PhysicsState`` other than ``engine`` are always finite, as ``divergence.GuardedPhysics`` sees
    to. Environments over equal physics share compiled programs; it must hence be hashable, and
    equal only to what computes the same.

    A subclass has the first six attributes, ``reset`` and ``step``; the rest have defaults.

    Attributes:
        geoms: the visible shapes, each fixed in a link's frame.
        dt: seconds of simulated time per control step.
        action_size: A, number of actuators.
        state_size: S, length of ``PhysicsState.obs``.
        backend: name of the physics backend.
        link_names: L names; ``link/index`` where the model has none. Row i of ``xpos`` and
            ``xquat`` belongs to ``link_names[i]``.
        rigs: cameras by name; ``default`` is the task's own. Without it a camera looks from a
            corner at everything but the ground.
        unfit_cameras: why other cameras of the model cannot be rigs, by name.
        followed_link: the link that a camera follows if nothing else is said.
        look: lights, sky and ground of the model, which are the looks ``default`` and ``dmc`` then.
        batch_last: whether a CPU computes a batch faster with the environments as last axis.
        compiler_options: what XLA needs on a CPU to make the programs fast.
    """

    geoms: Geoms
    dt: float
    action_size: int
    state_size: int
    backend: str
    link_names: tuple[str, ...]
    rigs: Mapping[str, CameraRig] = MappingProxyType({})
    unfit_cameras: Mapping[str, str] = MappingProxyType({})
    followed_link: int = 0
    look: Look | None = None
    batch_last: bool = True
    compiler_options: Mapping[str, Any] = MappingProxyType({})

    @abc.abstractmethod
    def reset(self, key: jax.Array) -> PhysicsState:
        """Sample the task's initial state.

        Args:
            key: PRNG key, the only source of randomness.

        Returns:
            The first state of an episode, with reward 0 and ``terminated`` false. Should the
            sample itself be non-finite, ``non_finite`` and ``terminated`` are true, the links
            are at the world's origin and the observation is 0.
        """

    @abc.abstractmethod
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

    def from_qpos(
        self, q: jax.Array, qd: jax.Array | None = None, *, key: jax.Array | None = None
    ) -> PhysicsState:
        """Return the first state of an episode, in a chosen pose.

        Args:
            q: (Q,) float32, joint positions in MuJoCo's order; quaternions of any length.
            qd: (V,) float32, joint velocities, 0 if not given.
            key: decides what the task samples besides, such as a target.

        Returns:
            A state that ``step`` accepts. ``terminated`` is false even if the task would end in
            this pose; the next step says so.

        Raises:
            ValueError: for a wrong shape.
            TypeError: this physics has no such function.
        """
        del q, qd, key
        raise TypeError(
            f"{type(self).__name__} cannot start in a chosen pose: give it a function "
            "from_qpos(q, qd, *, key) that returns the first state of an episode."
        )


def check_physics(physics: object) -> Physics:
    """Return ``physics`` if it is one.

    Raises:
        TypeError: it is not a subclass of ``Physics``.
    """
    if isinstance(physics, Physics):
        return physics
    raise TypeError(
        f"physics must be a pixelbrax_jax.Physics, got a {type(physics).__name__}: make its class "
        "a subclass, class MyPhysics(pixelbrax_jax.Physics)."
    )
