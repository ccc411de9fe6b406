"""PixelBrax: Brax physics seen through a pure-JAX ray-caster."""

from pixelbrax_jax.envs.check import check_env as check_env
from pixelbrax_jax.envs.pixel_env import PixelEnv as PixelEnv
from pixelbrax_jax.envs.vector import AUTORESET_MODES as AUTORESET_MODES
from pixelbrax_jax.envs.vector import VectorPixelEnv as VectorPixelEnv
from pixelbrax_jax.physics.base import Physics as Physics
from pixelbrax_jax.physics.brax_physics import BraxPhysics as BraxPhysics
from pixelbrax_jax.physics.mjcf_task import mjcf_physics as mjcf_physics
from pixelbrax_jax.registry import list_envs as list_envs
from pixelbrax_jax.registry import make as make
from pixelbrax_jax.registry import register as register
from pixelbrax_jax.renderer.base import render as render
from pixelbrax_jax.scene.cameras import named_rigs as named_rigs
from pixelbrax_jax.scene.cameras import rig as rig
from pixelbrax_jax.scene.look import make_look as make_look
from pixelbrax_jax.scene.place import place as place
from pixelbrax_jax.types import Camera as Camera
from pixelbrax_jax.types import CameraRig as CameraRig
from pixelbrax_jax.types import EnvParams as EnvParams
from pixelbrax_jax.types import EnvState as EnvState
from pixelbrax_jax.types import Frame as Frame
from pixelbrax_jax.types import GeomKind as GeomKind
from pixelbrax_jax.types import Geoms as Geoms
from pixelbrax_jax.types import Look as Look
from pixelbrax_jax.types import PhysicsState as PhysicsState
from pixelbrax_jax.types import Scene as Scene
from pixelbrax_jax.types import Timestep as Timestep
