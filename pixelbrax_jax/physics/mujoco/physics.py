"""Tasks of MuJoCo models as ``Physics``."""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.flags import default_flags, under_environment_flags
from pixelbrax_jax.memory import check_fits
from pixelbrax_jax.physics.divergence import GuardedPhysics
from pixelbrax_jax.physics.mujoco.dynamics import Dynamics, Readings, State
from pixelbrax_jax.physics.mujoco.formulas import Formulas, Snapshot, Start
from pixelbrax_jax.physics.mujoco.geometry import VISIBLE_GROUPS
from pixelbrax_jax.physics.mujoco.lighting import detailed
from pixelbrax_jax.physics.mujoco.native import compile_model, with_poses, without_textures
from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.physics.mujoco.poses import (
    body_names,
    center_of_mass,
    check_pose,
    with_unit_rotations,
)
from pixelbrax_jax.physics.mujoco.scene import COM_LINK, read_scene
from pixelbrax_jax.physics.task import Color
from pixelbrax_jax.types import CameraRig, Look, PhysicsState

_UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def _cpu() -> jax.Device | None:
    """Return the host's device; None, for JAX's default, where JAX_PLATFORMS has no CPU."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return None


class MujocoPhysics(GuardedPhysics):
    """A task of a MuJoCo model.

    Links are the model's bodies without the world, then, if the task has them, ``camera/com``, the
    center of mass that cameras and lights follow, and ``target``, this episode's target.
    """

    backend = "mujoco"
    varies = True
    # For these small sums and products, XLA's CPU library YNNPACK is slower than XLA's own loops.
    compiler_options = MappingProxyType({"xla_cpu_experimental_ynn_fusion_type": ""})

    @default_flags()
    def __init__(
        self,
        formulas: Formulas,
        spec: mujoco.MjSpec,
        *,
        engine: str,
        num_starts: int = 0,
        rigs: Mapping[str, CameraRig] = MappingProxyType({}),
        time_limit: int | None = None,
        colors: Mapping[str, Color] | None = None,
        geom_groups: Collection[int] = VISIBLE_GROUPS,
        identity: Hashable,
    ):
        """Compile the model, edited for the task, and read its scene; compile no program.

        The default camera is the model's, or the first of ``rigs`` if it has none.
        """
        bare = without_textures(spec)
        model, simulated, posed = compile_model(spec), compile_model(bare), with_poses(bare)
        for edited in (model, simulated, posed):
            formulas.edit(edited)
        scene = read_scene(
            model,
            formulas.camera,
            movable=formulas.movable,
            colors=colors,
            geom_groups=geom_groups,
        )
        self.geoms, self.look = scene.geoms, scene.look
        self.hull_errors, self.unfit_cameras = scene.hull_errors, scene.unfit_cameras
        default = scene.rigs.get("default") or scene.rig or next(iter(rigs.values()), None)
        self.rigs = {**scene.rigs, **rigs} | ({"default": default} if default else {})
        self.link_names = body_names(model) + scene.links
        self.dynamics = Dynamics(simulated, posed, formulas, engine)
        # Rounded, so that 0.0025 * 10 is 0.025.
        self.dt = float(f"{model.opt.timestep * formulas.substeps:.6g}")
        self.action_size = int(model.nu)
        self._formulas = formulas
        self._num_starts = num_starts
        # For the float32 arrays; sampling takes more.
        check_fits(f"num_starts={num_starts}", 4 * num_starts * (model.nq + model.nv))
        self._model = model
        self._extra_links = scene.links
        self.time_limit = time_limit
        self._identity = identity
        limited = model.actuator_ctrllimited.astype(bool)
        low, high = np.where(limited, model.actuator_ctrlrange.T, [[-1], [1]]).astype(np.float32)
        self._is_unit_range = bool((low == -1).all() and (high == 1).all())
        self._control_range = low, high
        # From a newly sampled state, so that those of ``num_starts`` are not computed.
        self._first = jax.eval_shape(
            lambda key: self.observe(*self._settle(formulas.start(self.dynamics, key))),
            jax.random.key(0),
        )
        self.state_size = int(self._first.obs.shape[0])

    def detailed_look(self, pixel: float) -> Look:
        """Return the look with all that MuJoCo's renderer draws; see ``Physics``."""
        return detailed(self._model, self.look, pixel)

    def control(self, action: jax.Array) -> jax.Array:
        """Map an action (A,) from [-1, 1] to the range of each control that has one."""
        action = jnp.asarray(action, jnp.float32)
        if self._is_unit_range:
            return action
        low, high = self._control_range
        return low + 0.5 * (action + 1) * (high - low)

    def observe(self, state: State, readings: Readings) -> PhysicsState:
        """Return poses, observation, reward and termination."""
        seen = Snapshot(self._model, state, readings)
        xpos, xquat = self._links(seen)
        return PhysicsState(
            engine=state.replace(remembered=self._formulas.remember(seen)),
            xpos=xpos,
            xquat=xquat,
            obs=self._formulas.observe(seen).astype(jnp.float32),
            reward=self._formulas.reward(seen).astype(jnp.float32),
            terminated=self._formulas.terminated(seen),
            non_finite=jnp.zeros((), bool),
        )

    def first(self, key: jax.Array, dynamics: jax.Array | None = None) -> tuple[State, Readings]:
        """Sample an initial state; return it and its readings."""
        return self._settle(self._start(key), dynamics)

    @under_environment_flags
    def from_qpos(
        self,
        q: jax.Array,
        qd: jax.Array | None = None,
        *,
        key: jax.Array | None = None,
        dynamics: jax.Array | None = None,
    ) -> PhysicsState:
        """See ``Physics.from_qpos``; ``key`` samples a target that is not a joint."""
        q, qd = check_pose(self._model, q, qd)
        start = self._start(jax.random.key(0) if key is None else key)
        start = start.replace(qpos=with_unit_rotations(self._model, q), qvel=qd)
        return self._guard_first(self.observe(*self._settle(start, dynamics, is_sampled=False)))

    def _start(self, key: jax.Array) -> Start:
        if not self._num_starts:
            return self._formulas.start(self.dynamics, key)
        row = jax.random.randint(key, (), 0, self._num_starts)
        start: Start = jax.tree.map(lambda rows: jnp.asarray(rows)[row], self._starts)
        return start

    @cached_property
    def _starts(self) -> Start:
        """Initial states of one sequence of keys, a row of NumPy arrays each, made on a CPU."""
        sample = jax.vmap(partial(self._formulas.start, self.dynamics.by_mujoco()))
        # The first use is within a program that is being traced, perhaps for an accelerator.
        with jax.ensure_compile_time_eval(), jax.default_device(_cpu()):
            keys = jax.random.split(jax.random.key(0), self._num_starts)
            made: Start = jax.device_get(jax.jit(sample)(keys))
        return made

    def _settle(
        self, start: Start, dynamics: jax.Array | None = None, *, is_sampled: bool = True
    ) -> tuple[State, Readings]:
        state = self.dynamics.state(start.qpos, start.qvel, start.target, dynamics)
        readings = self.dynamics.first(state, is_sampled=is_sampled)
        remembered = self._formulas.remember(Snapshot(self._model, state, readings))
        return state.replace(remembered=remembered), readings

    def move(self, state: State, action: jax.Array) -> tuple[State, Readings]:
        """Advance by one control step; return the state and its readings."""
        action = jnp.asarray(action, jnp.float32)
        return self.dynamics.step(state.replace(ctrl=self.control(action)), self._formulas.substeps)

    def _reset(self, key: jax.Array, *dynamics: jax.Array) -> PhysicsState:
        return self.observe(*self.first(key, *dynamics))

    def _step(self, state: PhysicsState, action: jax.Array) -> PhysicsState:
        return self.observe(*self.move(state.engine, action))

    def _watched(self, state: PhysicsState) -> Any:
        return state.engine, state.xpos

    def _links(self, seen: Snapshot) -> tuple[jax.Array, jax.Array]:
        xpos, xquat = seen.data.xpos[1:], seen.data.xquat[1:]
        com = center_of_mass(self._model, xpos, xquat)
        target = seen.state.target[:3]
        rows = [(com if name == COM_LINK else target)[None] for name in self._extra_links]
        upright = jnp.tile(jnp.array(_UPRIGHT), (len(rows), 1))
        return jnp.concatenate([xpos, *rows]), jnp.concatenate([xquat, upright])
