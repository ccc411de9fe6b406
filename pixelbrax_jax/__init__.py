"""PixelBrax: Brax physics seen through a pure-JAX ray-caster."""

from __future__ import annotations

import os
from importlib import import_module, metadata
from typing import TYPE_CHECKING, Any

from pixelbrax_jax.cache import KEEP_PROGRAMS, keep_programs

if TYPE_CHECKING:
    from pixelbrax_jax import distractors as distractors
    from pixelbrax_jax.compilation import compiler_options as compiler_options
    from pixelbrax_jax.config import EnvConfig as EnvConfig
    from pixelbrax_jax.distractors import load_clips as load_clips
    from pixelbrax_jax.envs.brax_env import BraxEnv as BraxEnv
    from pixelbrax_jax.envs.brax_env import wrap_fresh_episodes as wrap_fresh_episodes
    from pixelbrax_jax.envs.check import check_env as check_env
    from pixelbrax_jax.envs.making import make as make
    from pixelbrax_jax.envs.making import named_rigs as named_rigs
    from pixelbrax_jax.envs.pixel_env import PixelEnv as PixelEnv
    from pixelbrax_jax.envs.sharded import ShardedVectorEnv as ShardedVectorEnv
    from pixelbrax_jax.envs.vector import VectorPixelEnv as VectorPixelEnv
    from pixelbrax_jax.physics.base import Physics as Physics
    from pixelbrax_jax.physics.brax.engine import BraxPhysics as BraxPhysics
    from pixelbrax_jax.physics.mujoco.formulas import Snapshot as Snapshot
    from pixelbrax_jax.physics.mujoco.mjcf import mjcf_physics as mjcf_physics
    from pixelbrax_jax.physics.mujoco.playground import playground_physics as playground_physics
    from pixelbrax_jax.policy import list_pretrained as list_pretrained
    from pixelbrax_jax.policy import load_policy as load_policy
    from pixelbrax_jax.registry import list_envs as list_envs
    from pixelbrax_jax.registry import register as register
    from pixelbrax_jax.scene.look import make_look as make_look
    from pixelbrax_jax.spatial import make_rig as make_rig
    from pixelbrax_jax.types import Camera as Camera
    from pixelbrax_jax.types import CameraRig as CameraRig
    from pixelbrax_jax.types import EnvParams as EnvParams
    from pixelbrax_jax.types import EnvState as EnvState
    from pixelbrax_jax.types import GeomKind as GeomKind
    from pixelbrax_jax.types import Geoms as Geoms
    from pixelbrax_jax.types import Look as Look
    from pixelbrax_jax.types import PhysicsState as PhysicsState
    from pixelbrax_jax.types import Timestep as Timestep

if os.environ.get(KEEP_PROGRAMS) == "1":
    keep_programs()

# Loaded at first use, so that the list of tasks does not wait for JAX.
_PUBLIC = {
    "compilation": "compiler_options",
    "config": "EnvConfig",
    "distractors": "load_clips",
    "envs.brax_env": "BraxEnv wrap_fresh_episodes",
    "envs.check": "check_env",
    "envs.making": "make named_rigs",
    "envs.pixel_env": "PixelEnv",
    "envs.sharded": "ShardedVectorEnv",
    "envs.vector": "VectorPixelEnv",
    "physics.base": "Physics",
    "physics.brax.engine": "BraxPhysics",
    "physics.mujoco.formulas": "Snapshot",
    "physics.mujoco.mjcf": "mjcf_physics",
    "physics.mujoco.playground": "playground_physics",
    "policy": "list_pretrained load_policy",
    "registry": "list_envs register",
    "scene.look": "make_look",
    "spatial": "make_rig",
    "types": "Camera CameraRig EnvParams EnvState GeomKind Geoms Look PhysicsState Timestep",
}
_LAZY = {
    name: f"pixelbrax_jax.{module}" for module, names in _PUBLIC.items() for name in names.split()
}

__all__ = [*_LAZY, "distractors"]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return metadata.version("pixelbrax")
    if name == "distractors":
        return import_module("pixelbrax_jax.distractors")
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_LAZY[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
