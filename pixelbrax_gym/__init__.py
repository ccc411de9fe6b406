"""PixelBrax for Gymnasium and PyTorch.

Importing registers ``PixelBrax/Ant-v0`` and its ten siblings; nothing heavy is loaded before
the first environment is made, and torch only if tensors are wanted.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:
    from pixelbrax_gym.check import check_vector_env as check_vector_env
    from pixelbrax_gym.policy import TorchPolicy as TorchPolicy
    from pixelbrax_gym.sb3_env import PixelBraxSB3VecEnv as PixelBraxSB3VecEnv
    from pixelbrax_gym.single_env import PixelBraxEnv as PixelBraxEnv
    from pixelbrax_gym.torchrl_env import PixelBraxTorchRLEnv as PixelBraxTorchRLEnv
    from pixelbrax_gym.vector_env import PixelBraxVectorEnv as PixelBraxVectorEnv

# What needs an extra is not here, lest a star import fail without it.
__all__ = ["PixelBraxEnv", "PixelBraxVectorEnv", "check_vector_env", "register"]

_IDS = {
    "ant": "PixelBrax/Ant-v0",
    "halfcheetah": "PixelBrax/HalfCheetah-v0",
    "hopper": "PixelBrax/Hopper-v0",
    "humanoid": "PixelBrax/Humanoid-v0",
    "humanoidstandup": "PixelBrax/HumanoidStandup-v0",
    "inverted_double_pendulum": "PixelBrax/InvertedDoublePendulum-v0",
    "inverted_pendulum": "PixelBrax/InvertedPendulum-v0",
    "pusher": "PixelBrax/Pusher-v0",
    "reacher": "PixelBrax/Reacher-v0",
    "swimmer": "PixelBrax/Swimmer-v0",
    "walker2d": "PixelBrax/Walker2d-v0",
}

_LAZY = {
    "PixelBraxEnv": "pixelbrax_gym.single_env",
    "PixelBraxSB3VecEnv": "pixelbrax_gym.sb3_env",
    "PixelBraxTorchRLEnv": "pixelbrax_gym.torchrl_env",
    "PixelBraxVectorEnv": "pixelbrax_gym.vector_env",
    "TorchPolicy": "pixelbrax_gym.policy",
    "check_vector_env": "pixelbrax_gym.check",
}


def register(task: str, id: str | None = None) -> str:  # noqa: A002  # Gymnasium's word
    """Makes a task available to ``gymnasium.make`` and ``gymnasium.make_vec``.

    Args:
        task: the name under which ``pixelbrax_jax.register`` knows it.
        id: Gymnasium's name for it; ``"my_arm"`` becomes ``"PixelBrax/MyArm-v0"`` by default.

    Returns:
        The id.

    Raises:
        ValueError: there is no such task, or the id is taken.
    """
    from pixelbrax_jax.choices import check_choice
    from pixelbrax_jax.registry import list_envs

    check_choice("task", task, list_envs())
    if id is None:
        words = "".join(part[:1].upper() + part[1:] for part in task.split("_"))
        id = _IDS.get(task, f"PixelBrax/{words}-v0")  # noqa: A001
    if id in gymnasium.registry:
        raise ValueError(f"Gymnasium id {id!r} is registered already; choose another.")
    _register(task, id)
    return id


def _register(task: str, name: str) -> None:
    # No `max_episode_steps`: the environments count control steps themselves, and Gymnasium's
    # TimeLimit on top would count calls of step(), which are fewer under action repeat.
    gymnasium.register(
        id=name,
        entry_point="pixelbrax_gym.single_env:PixelBraxEnv",
        vector_entry_point="pixelbrax_gym.vector_env:PixelBraxVectorEnv",
        kwargs={"task": task},
    )


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_LAZY[name]), name)
    globals()[name] = value
    return value


for _task, _id in _IDS.items():
    _register(_task, _id)
