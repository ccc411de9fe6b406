"""What a task of a MuJoCo model is made of."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from pixelbrax_jax.physics.mujoco.dynamics import Dynamics, Readings, State
from pixelbrax_jax.physics.mujoco.needs import Needs
from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.spatial import f32, quat_multiply, quat_to_mat, rotate


class Start(struct.PyTreeNode):
    """An initial state with fields of ``State``; None means at rest or without a target."""

    qpos: jax.Array
    qvel: jax.Array | None = None
    target: jax.Array | None = None


@dataclass(frozen=True)
class Snapshot:
    """What observations and rewards read of one environment's state, by the model's names.

    Positions, velocities and their sensors are current; sensors of forces and accelerations are
    from the start of the last physics step, as in DM Control. Positions are metres in the world
    frame; rotations are matrices with the axes as columns, or unit quaternions (w, x, y, z).

    Attributes:
        state: positions, velocities, activations, the last controls (0 after a reset) and this
            episode's target.
        data: what MuJoCo computes from them, by its names of ``MjData``.
    """

    model: mujoco.MjModel
    state: State
    data: Readings

    @property
    def qpos(self) -> jax.Array:
        """All joint positions (Q,), in MuJoCo's order."""
        return self.state.qpos

    @property
    def qvel(self) -> jax.Array:
        """All joint velocities (V,), in MuJoCo's order."""
        return self.state.qvel

    def joint_pos(self, *names: str) -> jax.Array:
        """Return the positions of joints, concatenated; of a free joint 7 numbers, of a ball 4."""
        joints = map(self.model.joint, names)
        return self.state.qpos[_rows((j.qposadr[0], len(j.qpos0)) for j in joints)]

    def joint_vel(self, *names: str) -> jax.Array:
        """Return the velocities of joints, concatenated; of a free joint 6 numbers, of a ball 3."""
        joints = map(self.model.joint, names)
        # Damping has a number for each velocity.
        return self.state.qvel[_rows((j.dofadr[0], len(j.damping)) for j in joints)]

    def sensor(self, *names: str) -> jax.Array:
        """Return the readings of sensors, concatenated."""
        return self._sensors(self.model.sensor(name).id for name in names)

    def sensors_of(self, *kinds: mujoco.mjtSensor) -> jax.Array:
        """Return the readings of all sensors of some types, in the model's order."""
        wanted = {int(kind) for kind in kinds}
        return self._sensors(
            i for i, kind in enumerate(self.model.sensor_type) if int(kind) in wanted
        )

    def _sensors(self, indices: Iterable[int]) -> jax.Array:
        adr, dim = self.model.sensor_adr, self.model.sensor_dim
        return self.data.sensordata[_rows((adr[i], dim[i]) for i in indices)]

    def xpos(self, body: str) -> jax.Array:
        """Return (3,), the origin of a body."""
        return self.data.xpos[self.model.body(body).id]

    def xquat(self, body: str) -> jax.Array:
        """Return (4,), the rotation of a body."""
        return self.data.xquat[self.model.body(body).id]

    def xmat(self, body: str) -> jax.Array:
        """Return (3, 3), the rotation of a body."""
        return quat_to_mat(self.xquat(body))

    def xipos(self, body: str) -> jax.Array:
        """Return (3,), the center of mass of a body."""
        return self._place(self.model.body(body).id, self.model.body(body).ipos)

    def geom_pos(self, name: str) -> jax.Array:
        """Return (3,), the center of a geom."""
        geom = self.model.geom(name)
        return self._place(geom.bodyid[0], geom.pos)

    def geom_mat(self, name: str) -> jax.Array:
        """Return (3, 3), the rotation of a geom."""
        geom = self.model.geom(name)
        return self._rotation(geom.bodyid[0], geom.quat)

    def site_pos(self, name: str) -> jax.Array:
        """Return (3,), the center of a site."""
        site = self.model.site(name)
        return self._place(site.bodyid[0], site.pos)

    def site_mat(self, name: str) -> jax.Array:
        """Return (3, 3), the rotation of a site."""
        site = self.model.site(name)
        return self._rotation(site.bodyid[0], site.quat)

    def _place(self, body: int, pos: np.ndarray) -> jax.Array:
        return self.data.xpos[body] + rotate(self.data.xquat[body], f32(pos))

    def _rotation(self, body: int, quat: np.ndarray) -> jax.Array:
        return quat_to_mat(quat_multiply(self.data.xquat[body], f32(quat)))


def _rows(parts: Iterable[tuple[int, int]]) -> np.ndarray:
    """Return the indices of parts of an array, each given by its start and length."""
    return np.array([row for start, size in parts for row in range(start, start + size)], int)


def joined(*parts: jax.Array | float) -> jax.Array:
    """Return arrays and scalars, flattened and concatenated."""
    return jnp.concatenate([jnp.ravel(jnp.asarray(part)) for part in parts])


def observe_joints(seen: Snapshot) -> jax.Array:
    """Return all joint positions and velocities.

    * ``qpos``
    * ``qvel``
    """
    return observe_joints_from(seen, skipped=0)


def observe_joints_from(seen: Snapshot, *, skipped: int) -> jax.Array:
    """Return joint positions without the first ones, and velocities.

    * ``qpos[skipped:]``
    * ``qvel``
    """
    return joined(seen.state.qpos[skipped:], seen.state.qvel)


def _unchanged(model: mujoco.MjModel) -> None:
    del model


def never(seen: Snapshot) -> jax.Array:
    """Return False: the task lasts until the time limit."""
    del seen
    return jnp.zeros((), bool)


def nothing(seen: Snapshot) -> jax.Array:
    """Return no numbers: rewards compare with nothing."""
    del seen
    return jnp.zeros(0)


@dataclass(frozen=True, eq=False)
class Formulas(Needs):
    """Initial states, observation, reward and end of a task, and what they need of the engine.

    Attributes:
        remember: returns what the next reward finds in ``State.remembered``.
        substeps: physics steps per control step.
        edit: changes the compiled model as DM Control's task does.
        options: arguments of the model's generator.
        camera: index of the task's camera in the model; None for none.
        movable: names of the geoms, sites and lights that ``Start.target`` moves.
    """

    start: Callable[[Dynamics, jax.Array], Start]
    observe: Callable[[Snapshot], jax.Array]
    reward: Callable[[Snapshot], jax.Array]
    terminated: Callable[[Snapshot], jax.Array] = never
    remember: Callable[[Snapshot], Any] = nothing
    substeps: int = 1
    edit: Callable[[mujoco.MjModel], None] = _unchanged
    options: Mapping[str, Any] = field(default_factory=dict)
    camera: int | None = 0
    movable: tuple[str, ...] = ()
