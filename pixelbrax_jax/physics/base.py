"""The base class of all physics."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import jax
from flax import struct

from pixelbrax_jax.types import CameraRig, Geoms, Look, PhysicsState


class Kinematics(struct.PyTreeNode):
    """Poses and velocities, float32, in MuJoCo's order, the input of rewards of Brax's tasks.

    ``q`` (Q,) are joint positions (metres, radians; a free joint is a position and a quaternion),
    ``qd`` (V,) joint velocities, per second. ``xpos`` (L, 3), metres, and unit ``xquat`` (L, 4) are
    the origins and orientations of links in the world frame.
    """

    q: jax.Array
    qd: jax.Array
    xpos: jax.Array
    xquat: jax.Array


RewardFn = Callable[[Kinematics, Kinematics, jax.Array], jax.Array]
"""Maps the states before and after a step and the (A,) action to a scalar reward."""

ResetFn = Callable[[jax.Array], tuple[jax.Array, jax.Array]]
"""Maps a PRNG key to joint positions (Q,) and velocities (V,), as in ``Kinematics``."""


class Physics(abc.ABC):
    """A task's dynamics for ONE environment, as pure functions.

    ``reset`` and ``step`` may be jitted, vmapped and scanned; their states have the same tree,
    shapes and dtypes, so that a jitted ``step`` is traced once. All fields of a ``PhysicsState``
    but ``engine`` are always finite (``divergence.GuardedPhysics`` ensures it). Environments with
    equal physics share compiled programs, so physics must be hashable, and equal only if it
    computes the same.

    A subclass defines the first six attributes, ``reset`` and ``step``; the rest have defaults.

    Attributes:
        geoms: the visible shapes, each fixed in a link's frame.
        dt: seconds of simulated time per control step.
        action_size: A, number of actuators.
        state_size: S, length of ``PhysicsState.obs``.
        backend: name of the physics backend.
        link_names: L names, of the rows of ``xpos`` and ``xquat``; ``link/index`` if the model has
            none.
        rigs: cameras by name; ``default`` is the task's. Without it the camera shows all geoms but
            the ground from a corner.
        unfit_cameras: why other cameras of the model cannot be rigs, by name.
        time_limit: control steps after which the task ends every episode; None for no such limit.
        varies: whether ``reset`` and ``from_qpos`` also take ``dynamics``: (5,) float32 multipliers
            in the order of ``DynamicsRanges``, for the whole episode.
        followed_link: the link that a camera follows by default.
        hull_errors: metres by name of a mesh geom: largest distance of the drawn shape from the
            convex hull of the mesh.
        look: lights, sky and ground of the model, used as looks ``default`` and ``dmc-plain``; see
            ``detailed_look``.
        compiler_options: XLA options for fast programs on a CPU.
    """

    geoms: Geoms
    dt: float
    action_size: int
    state_size: int
    backend: str
    link_names: tuple[str, ...]
    rigs: Mapping[str, CameraRig] = MappingProxyType({})
    unfit_cameras: Mapping[str, str] = MappingProxyType({})
    time_limit: int | None = None
    varies: bool = False
    followed_link: int = 0
    hull_errors: Mapping[str, float] = MappingProxyType({})
    look: Look | None = None
    compiler_options: Mapping[str, Any] = MappingProxyType({})

    @abc.abstractmethod
    def reset(self, key: jax.Array) -> PhysicsState:
        """Sample the task's initial state, with ``key`` as the only source of randomness.

        Returns:
            The first state of an episode, with reward 0 and ``terminated`` false. If the sample is
            not finite, ``non_finite`` and ``terminated`` are true, links are at the world's origin
            and the observation is 0.
        """

    @abc.abstractmethod
    def step(self, state: PhysicsState, action: jax.Array) -> PhysicsState:
        """Advance by one control step under an (A,) float32 action. The caller clips it to [-1, 1].

        Returns:
            The next state. If the step diverged, it is the given state with reward 0, and
            ``terminated`` and ``non_finite`` true. A step after a termination continues the
            dynamics.
        """

    def detailed_look(self, pixel: float) -> Look | None:
        """Return ``look`` with what only look ``dmc`` shows, such as the sky's texture.

        ``pixel`` is the edge of a pixel at distance 1, which textures are averaged for.
        """
        del pixel
        return self.look

    def from_qpos(
        self, q: jax.Array, qd: jax.Array | None = None, *, key: jax.Array | None = None
    ) -> PhysicsState:
        """Return the first state of an episode in a chosen pose.

        Args:
            q: (Q,) float32, joint positions in MuJoCo's order; quaternions of any length.
            qd: (V,) float32, joint velocities, 0 by default.
            key: PRNG key for what else the task samples, such as a target.

        Returns:
            A state for ``step``, terminated only if the pose is not finite; the next step may be.

        Raises:
            ValueError: a shape is wrong.
            TypeError: this physics has no such function.
        """
        del q, qd, key
        raise TypeError(
            f"{type(self).__name__} cannot start in a chosen pose: give it a function "
            "from_qpos(q, qd, *, key) that returns the first state of an episode."
        )


def check_physics(physics: object) -> Physics:
    """Return ``physics``; raise TypeError if it is not a ``Physics`` with all its attributes."""
    kind = type(physics).__name__
    if not isinstance(physics, Physics):
        raise TypeError(
            f"physics must be a pixelbrax_jax.Physics, got {kind}: return what mjcf_physics "
            "makes, a BraxPhysics or an object of a class MyPhysics(pixelbrax_jax.Physics)."
        )
    missing = [name for name in Physics.__annotations__ if not hasattr(physics, name)]
    if missing:
        raise TypeError(f"{kind} lacks what a Physics has to declare: {', '.join(missing)}.")
    return physics
