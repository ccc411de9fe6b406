"""Brax's environments as ``Physics``."""

from __future__ import annotations

import contextlib
import copy
import copyreg
from collections.abc import Collection, Hashable, Iterator, Mapping
from importlib import import_module
from types import ModuleType
from typing import Any
from uuid import uuid4

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from pixelbrax_jax.flags import as_by_default, default_flags, is_key, under_environment_flags
from pixelbrax_jax.physics.base import Kinematics, RewardFn
from pixelbrax_jax.physics.divergence import GuardedPhysics, Recipe
from pixelbrax_jax.physics.mujoco.compatibility import (
    accept_old_clip,
    import_silenced,
    known_warnings_silenced,
)
from pixelbrax_jax.physics.mujoco.geometry import (
    VISIBLE_GROUPS,
    as_geoms,
    geom_shapes,
    hull_errors,
    site_shapes,
)
from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.physics.mujoco.poses import (
    body_names,
    check_pose,
    with_center_of_mass,
    with_unit_rotations,
)
from pixelbrax_jax.physics.mujoco.scene import COM_LINK
from pixelbrax_jax.physics.mujoco.viewpoints import followed_body, read_rigs
from pixelbrax_jax.physics.task import Color
from pixelbrax_jax.spatial import quat_normalize
from pixelbrax_jax.types import CameraRig, PhysicsState

with import_silenced():
    from brax import envs, fluid
    from brax.envs.wrappers import training
accept_old_clip(fluid)

# An environment holds its backend's module, which a pickle names.
copyreg.pickle(ModuleType, lambda module: (import_module, (module.__name__,)))

# These handle batches, time limits and resets, which the caller handles here.
_TRAINING_WRAPPERS = (
    training.AutoResetWrapper,
    training.DomainRandomizationVmapWrapper,
    training.EpisodeWrapper,
    training.EvalWrapper,
    training.VmapWrapper,
)


@struct.dataclass
class BraxCarry:
    """Brax's state besides what ``PhysicsState`` holds."""

    pipeline: Any
    metrics: dict[str, Any]
    info: dict[str, Any]


class BraxPhysics(GuardedPhysics):
    """A Brax environment as ``Physics``. The given environment is never modified.

    It differs from the environment in two points. Quaternions of free and ball joints are
    normalized before the first state is computed, because Brax adds reset noise to their entries. A
    diverging step ends the episode instead of returning NaN; joint and link positions and
    velocities, observation, reward and done flag are watched.

    On the ``"mjx"`` backend link poses are one physics step older than joint positions after a
    ``step`` (not after a ``reset``), because MuJoCo computes them before it integrates.

    If a camera of the model follows a center of mass, the last link is ``camera/com``.
    """

    @default_flags()
    def __init__(
        self,
        env: envs.Env,
        *,
        colors: Mapping[str, Color] | None = None,
        drawn_radius: Mapping[str, float] | None = None,
        geom_groups: Collection[int] = VISIBLE_GROUPS,
        rigs: Mapping[str, CameraRig] | None = None,
        unscale_actions: bool = False,
        reward: RewardFn | None = None,
        identity: Hashable | None = None,
    ):
        """Read the model and check the environment; compile nothing.

        Args:
            env: a bare environment, such as ``brax.envs.get_environment("ant")``.
            colors: replacements for colors by geom name, see ``geom_shapes``.
            drawn_radius: metres by name of a sphere to render larger, see ``geom_shapes``.
            geom_groups: MuJoCo's groups of visible geoms and sites.
            rigs: the task's viewpoints by name, and no sites; None takes the model's cameras, and
                renders its sites.
            unscale_actions: undo the environment's map of actions from [-1, 1] to the control
                range, so that costs and actuators use the given action.
            reward: replaces the environment's reward; maps the states before and after the step and
                the action to a scalar.
            identity: objects with equal identities are equal, and share compiled programs; with
                None an object equals only itself and its pickles. If it is a ``Recipe``, a pickle
                contains nothing else, and ``step`` is not checked.

        Raises:
            ValueError: ``env`` is wrapped for training, has no MuJoCo model, does not observe one
                flat array, changes the tree of its state in ``step``, uses features its backend
                lacks, or has geoms that the renderer does not support.
        """
        _check_env(env)
        env = _changed(env, sys=jax.tree.map(as_by_default, env.unwrapped.sys))
        model: mujoco.MjModel = env.unwrapped.sys.mj_model
        shapes = geom_shapes(
            model, colors=colors, drawn_radius=drawn_radius, geom_groups=geom_groups
        )
        # Brax rounds the time step to float32; six digits restore the model's number.
        self.dt = float(f"{float(env.dt):.6g}")
        self.action_size = int(env.action_size)
        self.backend: str = env.backend
        self.link_names = body_names(model)
        if rigs is None:
            shapes += site_shapes(model, geom_groups)
            self.followed_link = max(followed_body(model) - 1, 0)
            com_link = len(self.link_names)
            rigs, self.unfit_cameras = read_rigs(model, com_link)
            if any(rig.link == com_link for rig in rigs.values()):
                self.link_names += (COM_LINK,)
        self.rigs = rigs
        self.hull_errors = hull_errors(shapes)
        self.geoms = as_geoms([shape._replace(material="") for shape in shapes])
        self._model = model
        self._source = env
        self._env = _changed(env, pipeline_init=self._init)
        self._reward = reward
        self._control_range = _control_range(model) if unscale_actions else None
        self._identity = uuid4() if identity is None else identity
        self._read_shapes()
        # Tests check the steps of the package's tasks; each takes a second.
        if not isinstance(identity, Recipe):
            with _explained(self.backend):
                state = jax.eval_shape(self.reset, jax.random.key(0))
                jax.eval_shape(self.step, state, jnp.zeros(self.action_size))

    def _reset(self, key: jax.Array) -> PhysicsState:
        """See ``Physics.reset``. ``key`` may be typed, or uint32 like Brax's."""
        return self._first_state(self._env, key)

    @under_environment_flags
    def from_qpos(
        self, q: jax.Array, qd: jax.Array | None = None, *, key: jax.Array | None = None
    ) -> PhysicsState:
        """See ``Physics.from_qpos``.

        It runs the environment's reset with these joint positions and velocities, so that
        observation and pose agree. None of the built-in tasks samples anything else.
        """
        q, qd = check_pose(self._model, q, qd)

        def init(_q: jax.Array, _qd: jax.Array, *args: Any, **kwargs: Any) -> Any:
            return self._init(q, qd, *args, **kwargs)

        key = jax.random.key(0) if key is None else key
        return self._guard_first(self._first_state(_changed(self._source, pipeline_init=init), key))

    def _step(self, state: PhysicsState, action: jax.Array) -> PhysicsState:
        action = jnp.asarray(action, jnp.float32)
        carry = state.engine
        # Brax updates these dicts in place.
        metrics, info = jax.tree.map(lambda leaf: leaf, (carry.metrics, carry.info))
        with known_warnings_silenced():
            after = self._env.step(
                envs.State(
                    pipeline_state=carry.pipeline,
                    obs=state.obs.astype(self._obs_dtype),
                    reward=state.reward,
                    done=state.terminated.astype(jnp.float32),
                    metrics=metrics,
                    info=info,
                ),
                self._unscale(action),
            )
        reward = after.reward
        if self._reward is not None:
            now = kinematics(after.pipeline_state)
            reward = self._reward(kinematics(carry.pipeline), now, action)
        done = jnp.asarray(after.done)
        for name, value in (("the reward", jnp.asarray(reward)), ("done", done)):
            if value.shape != ():
                raise ValueError(f"{name} must be a scalar, got shape {value.shape}")
        # A NaN in the done flag makes the reward NaN, which the guard watches.
        reward = jnp.where(jnp.abs(done) < jnp.inf, jnp.asarray(reward, jnp.float32), jnp.nan)
        return self._state(after, reward, done > 0.5)

    def _unscale(self, action: jax.Array) -> jax.Array:
        if self._control_range is None:
            return action
        low, high = self._control_range
        return (action - low) / (high - low) * 2 - 1

    def _watched(self, state: PhysicsState) -> Any:
        pipeline = state.engine.pipeline
        return pipeline.q, pipeline.qd, pipeline.x, pipeline.xd

    def _first_state(self, env: envs.Env, key: jax.Array) -> PhysicsState:
        with known_warnings_silenced():
            first = env.reset(key)
        return self._state(first, jnp.zeros((), jnp.float32), jnp.zeros((), bool))

    def _state(
        self, brax_state: envs.State, reward: jax.Array, terminated: jax.Array
    ) -> PhysicsState:
        carry = _carry(brax_state)
        tree: Any = jax.tree.structure(self._dtypes)
        if jax.tree.structure(carry) != tree:
            raise ValueError("step changes the tree of the environment's state")
        # Brax writes Python numbers. With fixed dtypes a jitted step is not traced again.
        carry = jax.tree.map(_as_dtype, carry, self._dtypes)
        xpos, xquat = self._links(kinematics(brax_state.pipeline_state))
        return PhysicsState(
            engine=carry,
            xpos=xpos,
            xquat=xquat,
            obs=jnp.asarray(brax_state.obs, jnp.float32),
            reward=reward,
            terminated=terminated,
            non_finite=jnp.zeros((), bool),
        )

    def _links(self, seen: Kinematics) -> tuple[jax.Array, jax.Array]:
        if self.link_names[-1] != COM_LINK:
            return seen.xpos, seen.xquat
        return with_center_of_mass(self._model, seen.xpos, seen.xquat)

    def _init(self, q: jax.Array, qd: jax.Array, *args: Any, **kwargs: Any) -> Any:
        q = with_unit_rotations(self._model, q)
        return self._source.unwrapped.pipeline_init(q, qd, *args, **kwargs)

    def _read_shapes(self) -> None:
        with _explained(self.backend), known_warnings_silenced():
            first = jax.eval_shape(self._env.reset, jax.random.key(0))
        if not hasattr(first.obs, "shape") or len(first.obs.shape) != 1:
            raise ValueError(
                "the environment must observe one flat array, got "
                f"{jax.tree.map(lambda leaf: leaf.shape, first.obs)}"
            )
        links, bodies = first.pipeline_state.x.pos.shape[0], self._model.nbody - 1
        if links != bodies:
            raise ValueError(f"the environment's state has {links} links, its model {bodies}")
        self.state_size = int(first.obs.shape[0])
        self._obs_dtype = first.obs.dtype
        self._dtypes = jax.tree.map(lambda leaf: leaf.dtype, _carry(first))


def kinematics(pipeline_state: Any) -> Kinematics:
    """Return poses and velocities of a Brax backend's state."""
    return Kinematics(
        q=jnp.asarray(pipeline_state.q, jnp.float32),
        qd=jnp.asarray(pipeline_state.qd, jnp.float32),
        xpos=jnp.asarray(pipeline_state.x.pos, jnp.float32),
        xquat=quat_normalize(jnp.asarray(pipeline_state.x.rot, jnp.float32)),
    )


def _check_env(env: envs.Env) -> None:
    layer = env
    while isinstance(layer, envs.Wrapper):
        if isinstance(layer, _TRAINING_WRAPPERS):
            raise ValueError(
                f"the environment is wrapped in {type(layer).__name__}; pass the bare one, as "
                "brax.envs.get_environment returns it"
            )
        layer = layer.env
    if getattr(getattr(layer, "sys", None), "mj_model", None) is None:
        raise ValueError(
            f"{type(layer).__name__} has no MuJoCo model in env.sys.mj_model, so there is "
            "nothing to render"
        )


@contextlib.contextmanager
def _explained(backend: str) -> Iterator[None]:
    try:
        yield
    except (AssertionError, NotImplementedError, RuntimeError) as error:
        fix = "" if backend == "mjx" else " The 'mjx' backend simulates most of MuJoCo."
        raise ValueError(
            f"the {backend!r} backend cannot simulate this model: {error}{fix}"
        ) from error


def _changed(env: envs.Env, **attributes: Any) -> envs.Env:
    """Copy ``env`` with all wrappers, and set attributes of the innermost copy."""
    clone = copy.copy(env)
    if isinstance(env, envs.Wrapper):
        clone.env = _changed(env.env, **attributes)
    else:
        vars(clone).update(attributes)
    return clone


def _as_dtype(leaf: Any, dtype: Any) -> jax.Array:
    # A key in Brax's info is typed or uint32, like the key of reset.
    return leaf if is_key(dtype) else jnp.asarray(leaf, dtype)


def _carry(brax_state: envs.State) -> BraxCarry:
    return BraxCarry(brax_state.pipeline_state, brax_state.metrics, brax_state.info)


def _control_range(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    if not model.actuator_ctrllimited.all():
        raise ValueError("unscale_actions needs a control range on every actuator")
    low, high = model.actuator_ctrlrange.astype(np.float32).T
    return low, high
