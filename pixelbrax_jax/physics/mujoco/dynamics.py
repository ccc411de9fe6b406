"""Dynamics of any MuJoCo model: MuJoCo itself on a CPU, MuJoCo XLA on an accelerator."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from copy import copy
from functools import cached_property, partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from pixelbrax_jax._platform.by_platform import by_platform
from pixelbrax_jax._platform.folding import fold
from pixelbrax_jax._platform.host_call import host_call, register
from pixelbrax_jax.physics.mujoco.multipliers import check_varies
from pixelbrax_jax.physics.mujoco.native import Native
from pixelbrax_jax.physics.mujoco.needs import Needs
from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.physics.mujoco.options import ENGINES
from pixelbrax_jax.spatial import quat_normalize

if TYPE_CHECKING:
    from pixelbrax_jax.physics.mujoco.xla import Xla


class State(struct.PyTreeNode):
    """The integration state: all that the next step depends on, float32.

    Attributes:
        qpos: (Q,) joint positions: metres, radians, unit quaternions.
        qvel: (V,) joint velocities, per second.
        act: activations of actuators with a state.
        qacc_warmstart: (V,) accelerations from which the solver starts.
        ctrl: (A,) the last controls, for rewards.
        target: metres, this episode's: (3,), (7,) with a body's unit quaternion, (0,) for none.
        multipliers: (5,) of the dynamics in this episode; (0,) if nothing varies.
        remembered: arrays, what the next reward compares with; (0,) for most tasks.
    """

    qpos: jax.Array
    qvel: jax.Array
    act: jax.Array
    qacc_warmstart: jax.Array
    ctrl: jax.Array
    target: jax.Array
    multipliers: jax.Array
    remembered: Any


class Readings(struct.PyTreeNode):
    """What MuJoCo computes from a state, by its names of ``MjData``; float32; see ``Snapshot``.

    Attributes:
        xpos: (B, 3) metres, origins of all bodies, of the world first.
        xquat: (B, 4) unit quaternions, their orientations.
        sensordata: all sensors, in MuJoCo's units.
        moved: (Q,) change of the joint positions in the control step; 0 in a first state.
        fields: ``Formulas.reads`` by name.
    """

    xpos: jax.Array
    xquat: jax.Array
    sensordata: jax.Array
    moved: jax.Array
    fields: dict[str, jax.Array]


class Dynamics:
    """A model's dynamics, for one environment, by an engine of ``options.ENGINES``.

    With ``"auto"`` MuJoCo computes programs lowered for a CPU, in float64, and MuJoCo XLA all
    others, in float32; with ``needs.prefers_xla`` MuJoCo XLA takes the steps on a CPU, too.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        posed: mujoco.MjModel,
        needs: Needs,
        engine: str,
    ):
        """Take a model, and the same model compiled ``with_poses``."""
        self.model = model
        self.engine = engine
        self._needs = needs
        self._steps_by_xla = engine == "auto" and needs.prefers_xla
        self._target_body = model.body(needs.target_body).id if needs.target_body else None
        self.native = Native(model, posed, needs)
        # Equal in every process, so that JAX's cache finds the programs that contain it.
        self.name = "/".join([_digest(model), str(needs.reads_forces), *needs.reads])
        data = mujoco.MjData(model)
        fields = [getattr(data, name).shape for name in needs.reads]
        self._shapes = [(model.nbody, 3), (model.nbody, 4), (model.nsensordata,), *fields]
        if not ENGINES[engine].by_mujoco:
            # Raises errors about missing packages and unsupported models now.
            _ = self.xla

    def by_mujoco(self) -> Dynamics:
        """Return the same dynamics, all computed by MuJoCo itself in programs for a CPU."""
        other = copy(self)
        other.engine, other._steps_by_xla = "auto", False
        return other

    @cached_property
    def xla(self) -> Xla:
        """The engine for accelerators, loaded at the first use."""
        made_by = ENGINES[self.engine].made_by
        if made_by is None:
            raise NotImplementedError(
                f"engine={self.engine!r} computes on a CPU alone; for programs of other devices "
                "choose engine='xla', or engine='auto'."
            )
        # The first use may be within a program that is being traced.
        with jax.ensure_compile_time_eval():
            module, kind = made_by.split(":")
            loaded = import_module(f"pixelbrax_jax.physics.mujoco.{module}")
            engine: Xla = getattr(loaded, kind)(self.model, self._needs)
            return engine

    def state(
        self,
        qpos: jax.Array,
        qvel: jax.Array | None = None,
        target: jax.typing.ArrayLike | None = None,
        multipliers: jax.Array | None = None,
    ) -> State:
        """Return a state without control or activation; without velocities it is at rest."""
        model = self.model
        if multipliers is not None:
            check_varies(model)
        return State(
            qpos=jnp.asarray(qpos, jnp.float32),
            qvel=jnp.zeros(model.nv) if qvel is None else jnp.asarray(qvel, jnp.float32),
            act=jnp.zeros(model.na),
            qacc_warmstart=jnp.zeros(model.nv),
            ctrl=jnp.zeros(model.nu),
            target=jnp.zeros(0) if target is None else jnp.asarray(target, jnp.float32),
            multipliers=jnp.zeros(0) if multipliers is None else jnp.asarray(multipliers),
            remembered=jnp.zeros(0),
        )

    def step(self, state: State, num_steps: int) -> tuple[State, Readings]:
        """Advance by at least one physics step with the state's controls."""
        names = ("qpos", "qvel", "act", "qacc_warmstart")
        arrays = [getattr(state, name) for name in (*names, "ctrl", "multipliers")]
        shapes = [x.shape for x in (*arrays[:4], state.qpos)] + self._shapes
        results = self._call("step", arrays, shapes, num_steps)
        state = state.replace(**dict(zip(names, results, strict=False)))
        return state, self._readings(state, results[4], results[5:])

    def first(self, state: State, *, is_sampled: bool = True) -> Readings:
        """Return the readings of a first state; actuators are off, as in DM Control's resets.

        ``is_sampled``: whether the task sampled it; ``Needs.starts_with_forces`` is about those.
        """
        arrays = [state.qpos, state.qvel, state.multipliers]
        results = self._call("first", arrays, self._shapes, int(is_sampled))
        return self._readings(state, jnp.zeros_like(state.qpos), results)

    def _readings(self, state: State, moved: jax.Array, results: list[jax.Array]) -> Readings:
        xpos, xquat, sensordata, *fields = results
        if (at := self._target_body) is not None:
            xpos = xpos.at[at].set(state.target[:3])
            xquat = xquat.at[at].set(quat_normalize(state.target[3:]))
        by_name = dict(zip(self._needs.reads, fields, strict=True))
        return Readings(xpos, xquat, sensordata, moved, by_name)

    def clearances(self, qpos: jax.Array) -> jax.Array:
        """Return (G,) metres at joint positions (Q,): negative for a geom that overlaps another."""
        return self._call("clearances", [qpos], [(self.model.ngeom,)])[0]

    def _call(
        self, method: str, arrays: list[jax.Array], shapes: list[tuple[int, ...]], *options: int
    ) -> list[jax.Array]:
        arrays = [jnp.asarray(x, jnp.float32) for x in arrays]
        like = [jax.ShapeDtypeStruct(shape, np.float32) for shape in shapes]

        def by_native(*row: jax.Array) -> list[jax.Array]:
            function = partial(getattr(self.native, method), *options)
            name = "/".join([self.name, method, *map(str, options)])
            register(name, partial(_of_rows, function, [len(shape) for shape in shapes]))
            return host_call(name, row, like)

        def by_xla(*row: jax.Array) -> list[jax.Array]:
            return list(getattr(self.xla, method)(*options, *row))

        _, by_mujoco, has_derivatives = ENGINES[self.engine]
        if (has_derivatives and not by_mujoco) or (method == "step" and self._steps_by_xla):
            return by_xla(*arrays)
        who = "MuJoCo itself" if by_mujoco else f"engine={self.engine!r}"
        results: list[jax.Array] = by_platform(
            tuple(arrays),
            like,
            cpu=by_native if by_mujoco else None,
            default=fold(by_xla) if by_mujoco else by_xla,
            no_derivative=f"{who} has no derivatives: choose engine='xla', MuJoCo XLA, "
            "which has them.",
        )
        return results


def _of_rows(
    function: Callable[..., None], result_axes: Sequence[int], *arrays: np.ndarray
) -> None:
    """Call ``function``, which takes (N, ...) rows, with any number of leading axes.

    A row of an operand is a vector; a row of a result has as many axes as ``result_axes`` says.
    """
    num_operands = len(arrays) - len(result_axes)
    axes = [1] * num_operands + list(result_axes)
    shapes = [
        (x.shape[: x.ndim - n], x.shape[x.ndim - n :]) for x, n in zip(arrays, axes, strict=True)
    ]
    rows = (x.reshape(math.prod(s), *row) for x, (s, row) in zip(arrays, shapes, strict=True))
    function(*rows)


def _digest(model: mujoco.MjModel) -> str:
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return hashlib.sha256(content.tobytes()).hexdigest()[:32]
