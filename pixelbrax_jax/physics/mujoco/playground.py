"""Environments of MuJoCo Playground as tasks."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.flags import default_flags
from pixelbrax_jax.physics.divergence import GuardedPhysics
from pixelbrax_jax.physics.mujoco.compatibility import (
    import_silenced,
    load_onto_own_device,
    loading_silenced,
)
from pixelbrax_jax.physics.mujoco.geometry import VISIBLE_GROUPS
from pixelbrax_jax.physics.mujoco.lighting import detailed
from pixelbrax_jax.physics.mujoco.poses import body_names, with_center_of_mass
from pixelbrax_jax.physics.mujoco.scene import read_scene
from pixelbrax_jax.physics.mujoco.viewpoints import followed_body
from pixelbrax_jax.physics.task import Color
from pixelbrax_jax.types import Look, PhysicsState

with import_silenced():
    from mujoco import mjx
    from mujoco.mjx._src import io as mjx_io


class PlaygroundPhysics(GuardedPhysics):
    """A task of MuJoCo Playground, made by ``playground_physics``."""

    backend = "mjx"

    @default_flags()
    def __init__(
        self,
        env: Any,
        *,
        colors: Mapping[str, Color] | None = None,
        geom_groups: Collection[int] = VISIBLE_GROUPS,
    ):
        """Take an environment without wrappers and read its scene; compile no program."""
        for name in ("mj_model", "mjx_model", "reset", "step", "dt", "action_size"):
            if not hasattr(env, name):
                raise ValueError(
                    f"env must be an environment of MuJoCo Playground or its name, got a "
                    f"{type(env).__name__}, which has no {name}."
                )
        if getattr(env, "unwrapped", env) is not env:
            raise ValueError(
                f"env must be without wrappers, got a {type(env).__name__}: pass env.unwrapped."
            )
        if env.mjx_model.impl.value != "jax":
            raise ValueError(
                f"env computes with impl={env.mjx_model.impl.value!r}, which needs MuJoCo Warp: "
                "load it with config_overrides={'impl': 'jax'}."
            )
        model = env.mj_model
        scene = read_scene(model, None, colors=colors, geom_groups=geom_groups)
        self.geoms, self.look, self.rigs = scene.geoms, scene.look, scene.rigs
        self.hull_errors, self.unfit_cameras = scene.hull_errors, scene.unfit_cameras
        self.link_names = body_names(model) + scene.links
        self.followed_link = max(followed_body(model) - 1, 0)
        self.dt = float(f"{float(env.dt):.6g}")
        self.action_size = int(env.action_size)
        config = getattr(env, "_config", {})
        self.time_limit = config.get("episode_length")
        self._has_com = bool(scene.links)
        self._env = env
        key = jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0)))
        first = jax.eval_shape(env.reset, key)
        self._dtypes = jax.tree.map(lambda leaf: leaf.dtype, first)
        obs = jax.eval_shape(_flat, first.obs)
        self.state_size = int(obs.shape[0])

    def detailed_look(self, pixel: float) -> Look:
        """Return the look with all that MuJoCo's renderer draws; see ``Physics``."""
        return detailed(self._env.mj_model, self.look, pixel)

    def _reset(self, key: jax.Array) -> PhysicsState:
        return self._state(self._env.reset(jax.random.key_data(key)))

    def _step(self, state: PhysicsState, action: jax.Array) -> PhysicsState:
        return self._state(self._env.step(state.engine, jnp.asarray(action, jnp.float32)))

    def _watched(self, state: PhysicsState) -> Any:
        return state.engine.data.qpos, state.engine.data.qvel

    def _state(self, found: Any) -> PhysicsState:
        """Return Playground's state as ours, with poses that fit its joint positions."""
        # With fixed dtypes a jitted step is not traced again for its own output.
        engine = jax.tree.map(jnp.asarray, found, self._dtypes)
        poses = mjx.kinematics(self._env.mjx_model, engine.data)
        xpos, xquat = poses.xpos[1:], poses.xquat[1:]
        if self._has_com:
            xpos, xquat = with_center_of_mass(self._env.mj_model, xpos, xquat)
        return PhysicsState(
            engine=engine,
            xpos=xpos,
            xquat=xquat,
            obs=_flat(found.obs),
            reward=jnp.asarray(found.reward, jnp.float32),
            terminated=jnp.asarray(found.done) > 0.5,
            non_finite=jnp.zeros((), bool),
        )


def playground_physics(
    env: Any,
    config_overrides: Mapping[str, Any] | None = None,
    *,
    colors: Mapping[str, Color] | None = None,
    geom_groups: Collection[int] = VISIBLE_GROUPS,
) -> PlaygroundPhysics:
    """Make physics of an environment of MuJoCo Playground (package ``playground``).

    States, observations, rewards and ends are the environment's; pictures are PixelBrax's. MuJoCo
    XLA simulates it on every device. Actions, which Playground expects in [-1, 1], are passed on.
    Its ``episode_length`` ends an episode if it is shorter than the option of that name. Its
    ``action_repeat``, which Playground's training applies, is left to the option ``action_repeat``.

    Args:
        env: a name of Playground's registry, such as ``"CartpoleBalance"``, or an environment
            without wrappers, with ``impl="jax"``.
        config_overrides: changes of the environment's configuration, for a name.
        colors: replacements for the model's colors by geom name, red, green, blue in [0, 1].
        geom_groups: MuJoCo's groups of visible geoms and sites.

    Raises:
        ImportError: Playground is not installed.
        ValueError: the name is unknown, ``env`` is no such environment, or it cannot be rendered.
    """
    load_onto_own_device(mjx_io)
    if not isinstance(env, str):
        if config_overrides is not None:
            raise ValueError("config_overrides are for a name; make env with them instead.")
        return PlaygroundPhysics(env, colors=colors, geom_groups=geom_groups)
    try:
        with import_silenced():
            from mujoco_playground import registry
    except ImportError as error:
        raise ImportError(
            f"MuJoCo Playground cannot be imported ({error}); try: pip install playground"
        ) from error
    defaults = registry.get_default_config(env)
    plain = {"impl": "jax"} if "impl" in defaults else {}
    with loading_silenced():
        made = registry.load(env, config_overrides=plain | dict(config_overrides or {}))
    return PlaygroundPhysics(made, colors=colors, geom_groups=geom_groups)


def _flat(obs: Any) -> jax.Array:
    """Return an observation as (S,) float32; of several by name, ``state``."""
    if isinstance(obs, Mapping):
        obs = obs["state"] if "state" in obs else jnp.concatenate(jax.tree.leaves(obs))
    if obs.ndim != 1:
        raise ValueError(
            f"observations must be vectors, got shape {obs.shape}: load it without vision."
        )
    return jnp.asarray(obs, jnp.float32)
