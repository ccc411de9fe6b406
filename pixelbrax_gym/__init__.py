"""PixelBrax for Gymnasium and PyTorch.

Importing registers ``PixelBrax/Ant-v0`` and the other tasks; nothing heavy is loaded before
the first environment is made, and torch only if tensors are wanted.
"""

from __future__ import annotations

import importlib
from importlib import metadata
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from pixelbrax_jax.tasks import TASKS

if TYPE_CHECKING:
    from pixelbrax_gym.gymnasium.check import check_vector_env as check_vector_env
    from pixelbrax_gym.gymnasium.env import GymnasiumEnv as GymnasiumEnv
    from pixelbrax_gym.gymnasium.vector_env import GymnasiumVectorEnv as GymnasiumVectorEnv
    from pixelbrax_gym.policy import TorchPolicy as TorchPolicy
    from pixelbrax_gym.sb3.vec_env import SB3VecEnv as SB3VecEnv
    from pixelbrax_gym.torchrl.env import TorchRLEnv as TorchRLEnv

# What needs an extra is not here, lest a star import fail without it.
__all__ = ["GymnasiumEnv", "GymnasiumVectorEnv", "check_vector_env", "register"]

_LAZY = {
    "GymnasiumEnv": "pixelbrax_gym.gymnasium.env",
    "GymnasiumVectorEnv": "pixelbrax_gym.gymnasium.vector_env",
    "SB3VecEnv": "pixelbrax_gym.sb3.vec_env",
    "TorchPolicy": "pixelbrax_gym.policy",
    "TorchRLEnv": "pixelbrax_gym.torchrl.env",
    "check_vector_env": "pixelbrax_gym.gymnasium.check",
}

_ENV = "pixelbrax_gym.gymnasium.env:GymnasiumEnv"


def register(task: str, id: str | None = None) -> str:  # noqa: A002  # Gymnasium's name for it
    """Make a task available to ``gymnasium.make`` and ``gymnasium.make_vec``.

    Args:
        task: the name under which ``pixelbrax_jax.register`` knows it.
        id: Gymnasium's name for it; ``"my_arm"`` becomes ``"PixelBrax/MyArm-v0"`` by default.

    Returns:
        The id.

    Raises:
        ValueError: there is no such task, or the id stands for something else.
    """
    from pixelbrax_jax.registry import list_envs
    from pixelbrax_jax.validation import check_choice

    check_choice("task", task, list_envs())
    if id is None:
        name = "".join(part[:1].upper() + part[1:] for part in task.split("_"))
        id = f"PixelBrax/{name}-v0"  # noqa: A001
        id = TASKS[task].gymnasium_id if task in TASKS else id  # noqa: A001
    known = gym.registry.get(id)
    if known is None:
        _register(task, id)
    elif (known.entry_point, known.kwargs) != (_ENV, {"task": task}):
        raise ValueError(f"Gymnasium id {id!r} is registered already; choose another.")
    return id


def _register(task: str, name: str) -> None:
    # No `max_episode_steps`: the environments count control steps themselves, and Gymnasium's
    # TimeLimit on top would count calls of step(), which are fewer under action repeat.
    gym.register(
        id=name,
        entry_point=_ENV,
        vector_entry_point="pixelbrax_gym.gymnasium.vector_env:GymnasiumVectorEnv",
        kwargs={"task": task},
    )


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return metadata.version("pixelbrax")
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_LAZY[name]), name)
    globals()[name] = value
    return value


for _row in TASKS.values():
    _register(_row.name, _row.gymnasium_id)
