"""Tasks from an MJCF file and a few functions."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.flags import default_flags
from pixelbrax_jax.physics.base import Kinematics, ResetFn, RewardFn
from pixelbrax_jax.physics.brax.engine import BraxPhysics, kinematics
from pixelbrax_jax.physics.brax.omissions import check_simulated
from pixelbrax_jax.physics.brax.tasks import BACKENDS
from pixelbrax_jax.physics.mujoco.compatibility import import_silenced, loading_silenced
from pixelbrax_jax.physics.mujoco.geometry import VISIBLE_GROUPS, geom_shapes
from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.physics.task import Color

with import_silenced():
    from brax import envs
    from brax.io import mjcf
from pixelbrax_jax.validation import check_choice

_NO_REFSAFE = int(mujoco.mjtDisableBit.mjDSBL_REFSAFE)

# Brax's approximate inverse of the mass matrix makes damping explicit, and strong damping diverges.
# Forces on light links diverge with fewer line searches.
_EXACT_SOLUTIONS = {"matrix_inv_iterations": 0, "solver_maxls": 40}


def never(after: Kinematics) -> jax.Array:
    """Return False: the task never ends early."""
    del after
    return jnp.zeros((), bool)


def joint_state(after: Kinematics) -> jax.Array:
    """Return (Q + V,) float32, joint positions, then joint velocities."""
    return jnp.concatenate([after.q, after.qd])


class _Task(NamedTuple):
    reward: RewardFn
    terminated: Callable[[Kinematics], jax.Array]
    observation: Callable[[Kinematics], jax.Array]
    reset_noise: float
    n_frames: int
    init_q: np.ndarray | None
    reset: ResetFn | None


class MjcfEnv(envs.PipelineEnv):
    """A Brax environment for any model."""

    def __init__(self, model: mujoco.MjModel, task: _Task, backend: str):
        system = _load(model, backend)
        super().__init__(system, backend=backend, n_frames=task.n_frames)
        self._task = task
        self._model = model
        limited = model.actuator_ctrllimited.astype(bool)
        # An unlimited actuator takes the action unchanged.
        self._low = np.where(limited, model.actuator_ctrlrange[:, 0], -1).astype(np.float32)
        self._high = np.where(limited, model.actuator_ctrlrange[:, 1], 1).astype(np.float32)

    @property
    def action_size(self) -> int:
        """Return the number of actuators; Brax counts only those on joints."""
        return int(self._model.nu)

    def reset(self, rng: jax.Array) -> envs.State:
        """Sample joint positions and velocities, with the task's ``reset`` if it has one."""
        if self._task.reset is None:
            q, qd = self._around_initial_pose(rng)
        else:
            q, qd = (jnp.asarray(part, jnp.float32) for part in self._task.reset(rng))
        pipeline = self.pipeline_init(q, qd)
        zero = jnp.zeros(())
        return envs.State(pipeline, self._task.observation(kinematics(pipeline)), zero, zero)

    def _around_initial_pose(self, rng: jax.Array) -> tuple[jax.Array, jax.Array]:
        q_key, qd_key = jax.random.split(rng)
        noise = self._task.reset_noise
        q = self.sys.init_q if self._task.init_q is None else jnp.asarray(self._task.init_q)
        q = q + jax.random.uniform(q_key, q.shape, minval=-noise, maxval=noise)
        return q, jax.random.uniform(qd_key, (self._model.nv,), minval=-noise, maxval=noise)

    def step(self, state: envs.State, action: jax.Array) -> envs.State:
        """Advance by one control step and apply the task's functions."""
        control = self._low + (action + 1) * 0.5 * (self._high - self._low)
        pipeline = self.pipeline_step(state.pipeline_state, control)
        before, after = kinematics(state.pipeline_state), kinematics(pipeline)
        return state.replace(
            pipeline_state=pipeline,
            obs=self._task.observation(after),
            reward=self._task.reward(before, after, action),
            done=jnp.asarray(self._task.terminated(after), jnp.float32),
        )


@default_flags()
def mjcf_physics(
    source: str | Path,
    *,
    reward: RewardFn,
    terminated: Callable[[Kinematics], jax.Array] = never,
    observation: Callable[[Kinematics], jax.Array] = joint_state,
    reset_noise: float | None = None,
    n_frames: int = 5,
    init_q: np.ndarray | None = None,
    reset: ResetFn | None = None,
    backend: str = "mjx",
    colors: Mapping[str, Color] | None = None,
    geom_groups: Collection[int] = VISIBLE_GROUPS,
) -> BraxPhysics:
    """Make physics of a model in MuJoCo's MJCF (or URDF) format.

    An action in [-1, 1] is mapped linearly to an actuator's control range, or passed unchanged if
    the actuator has none. Bodies without joints are fused with their parents. The model starts at
    ``qpos0``, or at its custom numeric ``init_qpos``. Sites are rendered like geoms, as
    ``site/<name>``. The model's cameras are viewpoints by name, see ``named_rigs``.

    The functions are pure and take ONE environment.

    Args:
        source: a file, or the XML itself.
        reward: maps the states before and after a step and the (A,) action in [-1, 1] to a scalar.
        terminated: maps the state after a step to a () bool, true when the task ended.
        observation: maps a state to the (S,) float state observation.
        reset_noise: joint positions and velocities are sampled uniformly within plus or minus this
            of ``init_q`` and 0 (metres, radians, per second); 0.01 by default.
        n_frames: the model's time steps per control step.
        init_q: (Q,) initial joint positions; None for the model's.
        reset: samples initial joint positions and velocities from a PRNG key, in place of
            ``init_q`` and ``reset_noise``. It can set a goal: a body with joints but no actuator.
        backend: ``"mjx"`` simulates most of MuJoCo; the others are Brax's backends for trees of
            hinges, slides and free joints.
        colors: replacements for the model's colors by geom name, red, green, blue in [0, 1].
        geom_groups: MuJoCo's groups of visible geoms and sites.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the model cannot be compiled, simulated or rendered, has no joint or no
            actuator, or has features that the backend ignores; ``reset`` is given with ``init_q``
            or ``reset_noise``; or a function returns a wrong shape or dtype.
    """
    check_choice("backend", backend, BACKENDS)
    if reset is not None and (reset_noise is not None or init_q is not None):
        raise ValueError(
            "reset samples the whole initial state: leave reset_noise and init_q out, and add the "
            "noise in reset."
        )
    reset_noise = 0.01 if reset_noise is None else reset_noise
    if not math.isfinite(reset_noise) or reset_noise < 0:
        raise ValueError(f"reset_noise must be finite and not negative, got {reset_noise}")
    if n_frames < 1 or n_frames != int(n_frames):
        raise ValueError(f"n_frames must be a positive integer, got {n_frames}")
    model = _compile(source)
    if model.nv == 0:
        raise ValueError("the model has no joint, so nothing can move")
    if model.nu == 0:
        raise ValueError("the model has no actuator, so an agent could not act on it")
    check_simulated(model, backend)
    # Reports unsupported geoms before anything slow is loaded.
    geom_shapes(model, colors=colors, geom_groups=geom_groups)
    if init_q is not None:
        init_q = np.asarray(init_q, np.float32)
        if init_q.shape != (model.nq,):
            raise ValueError(f"init_q must have shape ({model.nq},), got {init_q.shape}")
    noise, frames = float(reset_noise), int(n_frames)
    task = _Task(reward, terminated, observation, noise, frames, init_q, reset)
    _check_functions(task, model)
    return BraxPhysics(MjcfEnv(model, task, backend), colors=colors, geom_groups=geom_groups)


def _compile(source: str | Path) -> mujoco.MjModel:
    is_xml = isinstance(source, str) and source.lstrip().startswith("<")
    what = "the given XML" if is_xml else f"{str(source)!r}"
    if not is_xml and not Path(source).is_file():
        raise FileNotFoundError(f"there is no MJCF file {str(Path(source).absolute())!r}")
    try:
        with loading_silenced():
            spec = (
                mujoco.MjSpec.from_string(str(source))
                if is_xml
                else mujoco.MjSpec.from_file(str(source))
            )
            # Then every body is a moving link. Brax's loader fuses in the XML text, where it
            # misses rotations that are not quaternions.
            spec.compiler.fusestatic = True
            return spec.compile()
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot compile {what}: {error}") from error


def _load(model: mujoco.MjModel, backend: str) -> mjcf.System:
    """Load the model for Brax, changed so that Brax's backends move it as MuJoCo does."""
    # MuJoCo XLA rejects models with this flag, which only reports energies.
    model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    if backend != "mjx":
        # A limit with a margin acts like an earlier one without; Brax ignores margins.
        model.jnt_range += np.outer(model.jnt_margin, [1, -1])
        model.jnt_margin[:] = 0
    if backend == "generalized" and not model.opt.disableflags & _NO_REFSAFE:
        for solref in (model.jnt_solref, model.geom_solref, model.pair_solref):
            constant = solref[:, 0]
            constant[:] = np.where(
                constant > 0, np.maximum(constant, 2 * model.opt.timestep), constant
            )
    try:
        with loading_silenced():
            system = mjcf.load_model(model)
    except NotImplementedError as error:
        raise ValueError(
            f"MuJoCo XLA, which loads models for all backends, cannot simulate this one: {error}"
        ) from error
    if backend == "generalized":
        numerics = {model.numeric(i).name for i in range(model.nnumeric)}
        chosen = {k: v for k, v in _EXACT_SOLUTIONS.items() if k not in numerics}
        system = system.replace(**chosen)
    return system


def _check_functions(task: _Task, model: mujoco.MjModel) -> None:
    def zeros(*shape: int) -> Any:
        return jax.ShapeDtypeStruct(shape, jnp.float32)

    links, action = model.nbody - 1, zeros(model.nu)
    state = Kinematics(zeros(model.nq), zeros(model.nv), zeros(links, 3), zeros(links, 4))
    _check_result("reward", "a scalar number", jax.eval_shape(task.reward, state, state, action))
    _check_result("terminated", "a scalar bool", jax.eval_shape(task.terminated, state))
    _check_result("observation", "a flat float array", jax.eval_shape(task.observation, state))
    if task.reset is None:
        return
    start = jax.eval_shape(task.reset, jax.random.key(0))
    shapes = jax.tree.map(lambda leaf: leaf.shape, start)
    if not isinstance(shapes, tuple | list) or list(shapes) != [(model.nq,), (model.nv,)]:
        raise ValueError(
            f"reset must return joint positions ({model.nq},) and velocities ({model.nv},), "
            f"got {shapes}"
        )


def _check_result(name: str, expected: str, result: object) -> None:
    shape, dtype = getattr(result, "shape", None), getattr(result, "dtype", None)
    if shape is not None and dtype is not None:
        is_float = jnp.issubdtype(dtype, jnp.floating)
        fits = {
            "reward": shape == () and (is_float or jnp.issubdtype(dtype, jnp.integer)),
            "terminated": shape == () and dtype == jnp.bool_,
            "observation": len(shape) == 1 and shape[0] > 0 and is_float,
        }[name]
        if fits:
            return
        result = f"shape {shape} and dtype {dtype}"
    raise ValueError(f"{name} must return {expected}, got {result}")
