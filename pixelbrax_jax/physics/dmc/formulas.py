"""Building blocks of the DM Control Suite's tasks."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from pixelbrax_jax.physics.mujoco.dynamics import Dynamics, Readings, State
from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.spatial import f32, quat_multiply, quat_to_mat, rotate

_MAX_ATTEMPTS = 1000
"""Largest number of sampled poses."""


class Start(struct.PyTreeNode):
    """An initial state with fields of ``State``; None means at rest or without a target."""

    qpos: jax.Array
    qvel: jax.Array | None = None
    target: jax.Array | None = None


@dataclass(frozen=True)
class Snapshot:
    """What observations and rewards read of one environment's state, by the model's names.

    Positions, velocities and their sensors are current; sensors of forces and accelerations are
    from the beginning of the last physics step, as in DM Control. Positions are metres in the world
    frame; rotations are matrices with the axes as columns, or unit quaternions (w, x, y, z).

    Attributes:
        state: positions, velocities, activations, the last controls (0 after a reset) and this
            episode's target.
        data: what MuJoCo computes from them, by its names of ``MjData``.
    """

    model: mujoco.MjModel
    state: State
    data: Readings

    def joint_pos(self, *names: str) -> jax.Array:
        """Return the positions of hinges and slides."""
        return self.state.qpos[np.array([self.model.joint(name).qposadr[0] for name in names])]

    def joint_vel(self, *names: str) -> jax.Array:
        """Return the velocities of hinges and slides."""
        return self.state.qvel[np.array([self.model.joint(name).dofadr[0] for name in names])]

    def sensor(self, *names: str) -> jax.Array:
        """Return the readings of sensors, concatenated."""
        rows: list[int] = []
        for name in names:
            sensor = self.model.sensor(name)
            rows.extend(range(sensor.adr[0], sensor.adr[0] + sensor.dim[0]))
        return self.data.sensordata[np.array(rows)]

    def sensors_of(self, *kinds: mujoco.mjtSensor) -> jax.Array:
        """Return the readings of all sensors of some types, in the model's order."""
        wanted = {int(kind) for kind in kinds}
        rows = [i for i, kind in enumerate(self.model.sensor_type) if int(kind) in wanted]
        return self.sensor(*(self.model.sensor(i).name for i in rows))

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


def joined(*parts: jax.Array | float) -> jax.Array:
    """Return arrays and scalars, flattened and concatenated."""
    return jnp.concatenate([jnp.ravel(jnp.asarray(part)) for part in parts])


def observe_joints(seen: Snapshot) -> jax.Array:
    """Return all joint positions and velocities."""
    return joined(seen.state.qpos, seen.state.qvel)


def tolerance(
    x: jax.Array,
    bounds: tuple[float, float] = (0.0, 0.0),
    margin: float = 0.0,
    sigmoid: str = "gaussian",
    value_at_margin: float = 0.1,
) -> jax.Array:
    """Return 1 within bounds (inclusive), and less with the distance outside.

    The formulas are those of section 4.3 of arXiv 1801.00690 and of
    ``dm_control.utils.rewards.tolerance``, with the sigmoids that the suite uses.

    Bounds may be infinite. At ``margin`` from them the result is ``value_at_margin``: in [0, 1),
    and not 0 for ``gaussian`` and ``long_tail``. With ``margin`` 0 it is 0 outside.
    """
    lower, upper = bounds
    inside = (x >= lower) & (x <= upper)
    if margin == 0:
        return jnp.where(inside, 1.0, 0.0)
    # The distance to an infinite bound would be infinite.
    distance = lower - x if upper == math.inf else jnp.where(x < lower, lower - x, x - upper)
    return jnp.where(inside, 1.0, _SIGMOIDS[sigmoid](distance / margin, value_at_margin))


def small_control(control: jax.Array) -> jax.Array:
    """Return 1 for controls of 0, and less the larger they are."""
    return tolerance(control, margin=1.0, value_at_margin=0.0, sigmoid="quadratic")


def rising(x: jax.Array, bound: float, margin: float, value_at_margin: float = 0.0) -> jax.Array:
    """Return 1 from a bound on, and linearly less below it; see ``tolerance``."""
    return tolerance(x, (bound, math.inf), margin, "linear", value_at_margin)


def _gaussian(x: jax.Array, value_at_1: float) -> jax.Array:
    return jnp.exp(-0.5 * (x * math.sqrt(-2 * math.log(value_at_1))) ** 2)


def _long_tail(x: jax.Array, value_at_1: float) -> jax.Array:
    return 1 / ((x * math.sqrt(1 / value_at_1 - 1)) ** 2 + 1)


def _linear(x: jax.Array, value_at_1: float) -> jax.Array:
    scaled = x * (1 - value_at_1)
    return jnp.where(jnp.abs(scaled) < 1, 1 - scaled, 0.0)


def _quadratic(x: jax.Array, value_at_1: float) -> jax.Array:
    scaled = x * math.sqrt(1 - value_at_1)
    return jnp.where(jnp.abs(scaled) < 1, 1 - scaled**2, 0.0)


_SIGMOIDS = {
    "gaussian": _gaussian,
    "linear": _linear,
    "long_tail": _long_tail,
    "quadratic": _quadratic,
}


def _unchanged(model: mujoco.MjModel) -> None:
    del model


@dataclass(frozen=True, eq=False)
class Formulas:
    """Initial states, observation and reward of a task.

    Attributes:
        start: samples an initial state from a key.
        observe: returns the observation, in DM Control's order.
        reward: returns the reward, in [0, 1].
        substeps: physics steps per control step.
        edit: changes the compiled model as DM Control's task does.
        options: arguments of the model's generator.
        camera: index of the task's camera in the model.
        movable: names of the geoms, sites and lights that ``Start.target`` moves.
        target_body: name of the body, fixed to the world, that it moves; empty for none.
        reads_forces: whether observations use sensors of forces or accelerations.
        starts_with_forces: whether these sensors are not 0 in an initial state.
        is_small: whether a CPU steps the model faster by MuJoCo XLA.
        out_of_reach: names of the geoms that never touch anything, which MuJoCo XLA then skips.
    """

    start: Callable[[Dynamics, jax.Array], Start]
    observe: Callable[[Snapshot], jax.Array]
    reward: Callable[[Snapshot], jax.Array]
    substeps: int = 1
    edit: Callable[[mujoco.MjModel], None] = _unchanged
    options: Mapping[str, Any] = field(default_factory=dict)
    camera: int = 0
    movable: tuple[str, ...] = ()
    target_body: str = ""
    reads_forces: bool = False
    starts_with_forces: bool = False
    is_small: bool = False
    out_of_reach: tuple[str, ...] = ()


def random_joints(model: mujoco.MjModel, key: jax.Array) -> jax.Array:
    """Sample joint positions (Q,) as DM Control's ``randomize_limited_and_rotational_joints`` does.

    Limited hinges and slides are uniform in their range, other hinges in [-pi, pi]. A free joint
    keeps its position; its quaternion is sampled uniformly from [0, 1]^4 and normalised, which is
    not uniform over rotations but is what DM Control does. There are no ball joints.
    """
    low, high = np.array(model.qpos0), np.array(model.qpos0)
    rotations = []
    for kind, limited, reach, at in zip(
        model.jnt_type, model.jnt_limited, model.jnt_range, model.jnt_qposadr, strict=True
    ):
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            low[at + 3 : at + 7], high[at + 3 : at + 7] = 0.0, 1.0
            rotations.append(int(at) + 3)
        elif limited:
            low[at], high[at] = reach
        elif kind == mujoco.mjtJoint.mjJNT_HINGE:
            low[at], high[at] = -np.pi, np.pi
    qpos = low + (high - low) * jax.random.uniform(key, (model.nq,))
    qpos = qpos.astype(jnp.float32)
    for at in rotations:
        quat = qpos[at : at + 4]
        qpos = qpos.at[at : at + 4].set(quat / jnp.linalg.norm(quat))
    return qpos


def random_rotation(key: jax.Array) -> jax.Array:
    """Sample a (4,) float32 unit quaternion, uniformly over rotations."""
    quat = jax.random.normal(key, (4,))
    return quat / jnp.linalg.norm(quat)


def free_of_contact(
    dynamics: Dynamics, key: jax.Array, sample: Callable[[jax.Array, Start], Start]
) -> Start:
    """Sample initial states until no geoms touch, at most ``_MAX_ATTEMPTS`` times.

    ``sample`` maps a key and the previous sample, at first all zeros, to an initial state. The last
    one is returned even if geoms touch.
    """

    def again(carry: tuple[jax.Array, Start, jax.Array]) -> jax.Array:
        attempt, _, touches = carry
        return touches & (attempt < _MAX_ATTEMPTS)

    def attempt(
        carry: tuple[jax.Array, Start, jax.Array],
    ) -> tuple[jax.Array, Start, jax.Array]:
        number, before, _ = carry
        start = sample(jax.random.fold_in(key, number), before)
        return number + 1, start, dynamics.touches(start.qpos)

    zeros = Start(jnp.zeros(dynamics.model.nq), jnp.zeros(dynamics.model.nv))
    shapes = jax.eval_shape(sample, key, zeros)
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return jax.lax.while_loop(again, attempt, (jnp.int32(0), nothing, jnp.bool_(True)))[1]


def start_anywhere(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample joint positions as ``random_joints``, without a check for contacts."""
    return Start(random_joints(dynamics.model, key))


def start_free_of_contact(dynamics: Dynamics, key: jax.Array) -> Start:
    """Sample joint positions as ``random_joints`` until no geoms touch."""
    return free_of_contact(dynamics, key, lambda key, _: start_anywhere(dynamics, key))
