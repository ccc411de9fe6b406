"""What observations and rewards read of a state, by the names of the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.physics.opengl import mujoco


@dataclass(frozen=True)
class Snapshot:
    """The refreshed state of one environment.

    Positions, velocities and their sensors belong to the present joint positions and velocities;
    sensors of forces and accelerations to the last step, before it moved anything. These are the
    values that DM Control reads, after ``mj_step2`` and ``mj_step1``.

    Attributes:
        model: the compiled model.
        data: ``mujoco.mjx.Data`` of the state.
        target: (3,) float32, metres, where this episode's target is; (7,) with its unit quaternion,
            where it is a body; (0,) for tasks without.
    """

    model: mujoco.MjModel
    data: Any
    target: jax.Array

    @property
    def qpos(self) -> jax.Array:
        """(Q,) float32, joint positions: metres, radians."""
        return self.data.qpos

    @property
    def qvel(self) -> jax.Array:
        """(V,) float32, joint velocities, per second."""
        return self.data.qvel

    @property
    def act(self) -> jax.Array:
        """Activations of actuators that have a state."""
        return self.data.act

    @property
    def ctrl(self) -> jax.Array:
        """(A,) float32, the controls of the last step; 0 after a reset."""
        return self.data.ctrl

    def joint_pos(self, *names: str) -> jax.Array:
        """Return the positions of hinges and sliders."""
        return self.qpos[np.array([self.model.joint(name).qposadr[0] for name in names])]

    def joint_vel(self, *names: str) -> jax.Array:
        """Return the velocities of hinges and sliders."""
        return self.qvel[np.array([self.model.joint(name).dofadr[0] for name in names])]

    def sensor(self, *names: str) -> jax.Array:
        """Return the readings of sensors, one after the other."""
        rows: list[int] = []
        for name in names:
            sensor = self.model.sensor(name)
            rows.extend(range(sensor.adr[0], sensor.adr[0] + sensor.dim[0]))
        return self.data.sensordata[np.array(rows)]

    def sensors_of(self, *kinds: mujoco.mjtSensor) -> jax.Array:
        """Return the readings of all sensors of some kinds, in the model's order."""
        wanted = {int(kind) for kind in kinds}
        rows = [i for i, kind in enumerate(self.model.sensor_type) if int(kind) in wanted]
        return self.sensor(*(self.model.sensor(i).name for i in rows))

    def xpos(self, body: str) -> jax.Array:
        """Return (3,) metres, the origin of a body in the world frame."""
        return self.data.xpos[self.model.body(body).id]

    def xipos(self, body: str) -> jax.Array:
        """Return (3,) metres, the centre of mass of a body in the world frame."""
        return self.data.xipos[self.model.body(body).id]

    def xmat(self, body: str) -> jax.Array:
        """Return (3, 3), the axes of a body as columns in the world frame."""
        return self.data.xmat[self.model.body(body).id]

    def xquat(self, body: str) -> jax.Array:
        """Return (4,), the unit quaternion (w, x, y, z) of a body in the world frame."""
        return self.data.xquat[self.model.body(body).id]

    def xmats(self) -> jax.Array:
        """Return (L, 3, 3), the axes of all bodies but the world."""
        return self.data.xmat[1:]

    def geom_pos(self, name: str) -> jax.Array:
        """Return (3,) metres, the centre of a geom in the world frame."""
        return self.data.geom_xpos[self.model.geom(name).id]

    def geom_mat(self, name: str) -> jax.Array:
        """Return (3, 3), the axes of a geom as columns in the world frame."""
        return self.data.geom_xmat[self.model.geom(name).id]

    def site_pos(self, name: str) -> jax.Array:
        """Return (3,) metres, the centre of a site in the world frame."""
        return self.data.site_xpos[self.model.site(name).id]


def joined(*parts: jax.Array | float) -> jax.Array:
    """Return arrays and scalars one after the other, flattened."""
    return jnp.concatenate([jnp.ravel(jnp.asarray(part)) for part in parts])
