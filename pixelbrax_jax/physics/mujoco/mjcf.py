"""Tasks of a model in MuJoCo's format and a few functions."""

from __future__ import annotations

import inspect
import os
import warnings
from collections.abc import Callable, Collection, Mapping
from numbers import Integral
from operator import attrgetter
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.flags import default_flags
from pixelbrax_jax.physics.base import ResetFn
from pixelbrax_jax.physics.divergence import LARGEST
from pixelbrax_jax.physics.mujoco.compatibility import loading_silenced
from pixelbrax_jax.physics.mujoco.dynamics import Dynamics
from pixelbrax_jax.physics.mujoco.formulas import Formulas, Snapshot, Start, never, observe_joints
from pixelbrax_jax.physics.mujoco.geometry import VISIBLE_GROUPS, translucent
from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.physics.mujoco.options import MujocoOptions
from pixelbrax_jax.physics.mujoco.physics import MujocoPhysics
from pixelbrax_jax.physics.mujoco.poses import with_unit_rotations
from pixelbrax_jax.physics.mujoco.viewpoints import followed_body
from pixelbrax_jax.physics.task import Color
from pixelbrax_jax.types import PhysicsState
from pixelbrax_jax.validation import check_array, check_not_negative, check_positive_int

RewardFn = Callable[[Snapshot, Snapshot, jax.Array], jax.Array]

_FORCES = int(mujoco.mjtStage.mjSTAGE_ACC)


class MjcfPhysics(MujocoPhysics):
    """A user's task of a MuJoCo model, made by ``mjcf_physics``."""

    def __init__(self, reward: RewardFn, formulas: Formulas, spec: mujoco.MjSpec, **options: Any):
        """See ``MujocoPhysics``; ``reward`` replaces that of the formulas."""
        self._reward = reward
        super().__init__(formulas, spec, identity=None, **options)
        self.followed_link = max(followed_body(self._model) - 1, 0)
        # Its functions are checked before a program is traced.
        jax.eval_shape(self.step, self._first, jnp.zeros(self.action_size))

    def _step(self, state: PhysicsState, action: jax.Array) -> PhysicsState:
        before = Snapshot(self._model, state.engine, state.engine.remembered)
        engine, readings = self.move(state.engine, action)
        reward = self._reward(before, Snapshot(self._model, engine, readings), action)
        reward = _checked("reward", "a scalar number", reward, 0, jnp.number)
        return self.observe(engine, readings).replace(reward=reward.astype(jnp.float32))


@default_flags()
def mjcf_physics(
    source: str | Path,
    *,
    reward: RewardFn,
    observe: Callable[[Snapshot], jax.Array] = observe_joints,
    terminated: Callable[[Snapshot], jax.Array] = never,
    reset: ResetFn | None = None,
    init_q: np.typing.ArrayLike | None = None,
    reset_noise: float | None = None,
    n_frames: int = 5,
    engine: str = "auto",
    num_starts: int = 0,
    colors: Mapping[str, Color] | None = None,
    geom_groups: Collection[int] = VISIBLE_GROUPS,
) -> MjcfPhysics:
    """Make physics of a model in MuJoCo's MJCF format.

    MuJoCo itself simulates it in programs for a CPU, MuJoCo XLA in others. An action in [-1, 1] is
    mapped linearly to an actuator's control range, or passed unchanged if the actuator has none.
    What is seen are the model's geoms and sites (``site/<name>``), lights and sky; a UserWarning
    names the translucent ones, which are rendered opaque. Its cameras are viewpoints by name, see
    ``named_rigs``; without one named ``default``, a view from a corner follows the first moving
    body with an actuator.

    The functions are pure and take ONE environment, as a ``Snapshot``: ``seen.xpos("hand")``,
    ``seen.sensor("touch")``, ``seen.state.qvel``.

    Args:
        source: a file, or the XML itself.
        reward: maps the snapshots before and after a step and the (A,) action in [-1, 1] to a
            scalar.
        observe: maps a snapshot to the (S,) float state observation; by default all joint positions
            and velocities.
        terminated: maps the snapshot after a step to a () bool, true when the task ended.
        reset: samples initial joint positions (Q,) and velocities (V,) from a PRNG key, in place of
            ``init_q`` and ``reset_noise``. It can set a goal: a body with joints but no actuator.
        init_q: (Q,) initial joint positions; None for the model's first keyframe, or ``qpos0``.
        reset_noise: joint positions and velocities are sampled uniformly within plus or minus this
            of ``init_q`` and 0 (metres, radians, per second); 0.01 by default.
        n_frames: the model's time steps per control step.
        engine: ``auto``, ``mujoco``, ``xla``, ``mjx`` or ``warp``, as for the DM Control Suite.
        num_starts: number of initial states made once, of which each episode draws one; 0 samples
            a new one for each.
        colors: replacements for the model's colors by geom name, red, green, blue in [0, 1].
        geom_groups: MuJoCo's groups of visible geoms and sites.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the model cannot be compiled or rendered, has no joint or no actuator; ``reset``
            is given with ``init_q`` or ``reset_noise``; or a function returns a wrong shape or
            dtype.
        TypeError: a function takes another number of arguments.
    """
    options = MujocoOptions(engine=engine, num_starts=num_starts)
    if reset is not None and (reset_noise is not None or init_q is not None):
        raise ValueError(
            "reset samples the whole initial state: leave reset_noise and init_q out, and add the "
            "noise in reset."
        )
    noise = 0.01 if reset_noise is None else check_not_negative("reset_noise", reset_noise)
    if not noise < LARGEST:
        raise ValueError(f"reset_noise must be below {LARGEST:g}, got {reset_noise!r}.")
    _check_groups(geom_groups)
    substeps = check_positive_int("n_frames", n_frames)
    spec, model = _load(source)
    if model.nv == 0:
        raise ValueError("the model has no joint, so nothing can move")
    if model.nu == 0:
        raise ValueError("the model has no actuator, so an agent could not act on it")
    if names := translucent(model, geom_groups):
        warnings.warn(
            f"rendered opaque, because translucent things cannot be rendered: {', '.join(names)}. "
            "Give each an alpha of 1, or hide it with an alpha of 0 or a group outside "
            f"{tuple(geom_groups)}.",
            stacklevel=3,
        )
    _check_takes("reward", reward, "before", "after", "action")
    _check_takes("observe", observe, "snapshot")
    _check_takes("terminated", terminated, "snapshot")
    if reset is not None:
        _check_takes("reset", reset, "key")
    senses_forces = bool((model.sensor_needstage == _FORCES).any())
    formulas = Formulas(
        start=_start(model, reset, init_q, noise),
        observe=lambda seen: _checked(
            "observe", "a flat float array", observe(seen), 1, jnp.floating
        ),
        # ``MjcfPhysics`` computes it: it knows the snapshot before the step, and the action.
        reward=lambda _: jnp.zeros(()),
        terminated=lambda seen: _checked(
            "terminated", "a scalar bool", terminated(seen), 0, jnp.bool_
        ),
        remember=attrgetter("data"),
        camera=None,
        substeps=substeps,
        reads_forces=senses_forces,
        starts_with_forces=senses_forces,
    )
    return MjcfPhysics(
        reward, formulas, spec, colors=colors, geom_groups=geom_groups, **vars(options)
    )


def _load(source: str | Path) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    is_xml = isinstance(source, str) and source.lstrip().startswith("<")
    what = "the given XML"
    if not is_xml:
        source = Path(source).expanduser().absolute()
        what = repr(str(source))
        # ``Path.is_file`` fails with a name that is too long.
        if not os.path.isfile(source):  # noqa: PTH113
            raise FileNotFoundError(f"there is no MJCF file {what}; XML itself begins with '<'.")
    read = mujoco.MjSpec.from_string if is_xml else mujoco.MjSpec.from_file
    try:
        with loading_silenced():
            spec = read(str(source))
            return spec, spec.compile()
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot compile {what}: {error}") from error


def _start(
    model: mujoco.MjModel, reset: ResetFn | None, init_q: np.typing.ArrayLike | None, noise: float
) -> Callable[[Dynamics, jax.Array], Start]:
    what = "init_q"
    if init_q is None:
        what = "qpos of the model's first keyframe" if model.nkey else "qpos0 of the model"
        init_q = model.key_qpos[0] if model.nkey else model.qpos0
    initial = check_array(what, init_q, (model.nq,))
    if not (np.abs(initial) < LARGEST).all():
        raise ValueError(f"{what} must lie between -{LARGEST:g} and {LARGEST:g}, got {init_q}.")

    def around(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        q_key, qd_key = jax.random.split(key)
        qpos = jax.random.uniform(q_key, (model.nq,), minval=-noise, maxval=noise)
        qvel = jax.random.uniform(qd_key, (model.nv,), minval=-noise, maxval=noise)
        return qpos + initial, qvel

    def start(dynamics: Dynamics, key: jax.Array) -> Start:
        del dynamics
        found = (reset or around)(key)
        shapes = jax.tree.map(jnp.shape, found)
        if not isinstance(shapes, tuple | list) or list(shapes) != [(model.nq,), (model.nv,)]:
            raise ValueError(
                f"reset must return joint positions ({model.nq},) and velocities ({model.nv},), "
                f"got {shapes}"
            )
        qpos, qvel = (jnp.asarray(part, jnp.float32) for part in found)
        return Start(with_unit_rotations(model, qpos), qvel)

    return start


def _check_groups(groups: object) -> None:
    known = range(mujoco.mjNGROUP)

    def is_one(group: object) -> bool:
        return isinstance(group, Integral) and not isinstance(group, bool) and group in known

    if not isinstance(groups, Collection) or not all(map(is_one, groups)):
        raise ValueError(
            f"geom_groups must be a collection of MuJoCo's groups, 0 to {mujoco.mjNGROUP - 1}, got "
            f"{groups!r}."
        )


def _check_takes(name: str, function: Callable[..., Any], *arguments: str) -> None:
    """Raise a TypeError if a function cannot be called with these arguments."""
    try:
        signature = inspect.signature(function)
    except ValueError:
        # Some functions written in C have no signature.
        return
    except TypeError as error:
        raise TypeError(f"{name} must be a function, got {function!r}.") from error
    try:
        signature.bind(*arguments)
    except TypeError as error:
        raise TypeError(
            f"{name} must be a function of ({', '.join(arguments)}), but got {function!r}: {error}."
        ) from error


def _checked(name: str, expected: str, result: Any, ndim: int, kind: Any) -> jax.Array:
    """Return a function's result; raise ValueError if it is empty or has another shape or dtype."""
    if isinstance(result, (bool, int, float)):
        result = jnp.asarray(result)
    shape, dtype = getattr(result, "shape", None), getattr(result, "dtype", None)
    if shape is None or dtype is None:
        raise ValueError(f"{name} must return {expected}, got {result!r}")
    if len(shape) != ndim or 0 in shape or not jnp.issubdtype(dtype, kind):
        raise ValueError(f"{name} must return {expected}, got shape {shape} and dtype {dtype}")
    return jnp.asarray(result)
