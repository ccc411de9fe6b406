"""Provide PixelBrax for Gymnasium and PyTorch; importing it registers ``PixelBrax/Ant-v0`` etc."""

from __future__ import annotations

import importlib
import re
from importlib import metadata
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from pixelbrax_jax.tasks import TASKS

if TYPE_CHECKING:
    from pixelbrax_gym.generalisation.evaluation import evaluate_suite as evaluate_suite
    from pixelbrax_gym.generalisation.pairs import record_pairs as record_pairs
    from pixelbrax_gym.generalisation.scores import Scores as Scores
    from pixelbrax_gym.gymnasium.check import check_vector_env as check_vector_env
    from pixelbrax_gym.gymnasium.env import GymnasiumEnv as GymnasiumEnv
    from pixelbrax_gym.gymnasium.vector_env import GymnasiumVectorEnv as GymnasiumVectorEnv
    from pixelbrax_gym.policy import TorchPolicy as TorchPolicy
    from pixelbrax_gym.sb3.vec_env import SB3VecEnv as SB3VecEnv
    from pixelbrax_gym.torchrl.env import TorchRLEnv as TorchRLEnv

# Names that need an extra are missing, so that a star import works without it.
__all__ = [
    "GymnasiumEnv",
    "GymnasiumVectorEnv",
    "Scores",
    "check_vector_env",
    "evaluate_suite",
    "record_pairs",
    "register",
]

_LAZY = {
    "GymnasiumEnv": "pixelbrax_gym.gymnasium.env",
    "GymnasiumVectorEnv": "pixelbrax_gym.gymnasium.vector_env",
    "Scores": "pixelbrax_gym.generalisation.scores",
    "SB3VecEnv": "pixelbrax_gym.sb3.vec_env",
    "TorchPolicy": "pixelbrax_gym.policy",
    "TorchRLEnv": "pixelbrax_gym.torchrl.env",
    "check_vector_env": "pixelbrax_gym.gymnasium.check",
    "evaluate_suite": "pixelbrax_gym.generalisation.evaluation",
    "record_pairs": "pixelbrax_gym.generalisation.pairs",
}

_ENV = "pixelbrax_gym.gymnasium.env:GymnasiumEnv"


def register(task: str, id: str | None = None) -> str:  # noqa: A002  # Gymnasium's name for it
    """Register a task for ``gymnasium.make`` and ``gymnasium.make_vec``, and return its id.

    Args:
        task: name of the task in ``pixelbrax_jax.register``.
        id: Gymnasium id; by default ``"my_arm"`` becomes ``"PixelBrax/MyArm-v0"``.

    Raises:
        ValueError: the task is unknown, or the id belongs to another environment.
    """
    from pixelbrax_jax.registry import list_envs
    from pixelbrax_jax.validation import check_choice

    check_choice("task", task, list_envs())
    if id is None:
        name = "".join(part[:1].upper() + part[1:] for part in re.split(r"[^\w:.-]+|_+", task))
        id = TASKS[task].gymnasium_id if task in TASKS else f"PixelBrax/{name}-v0"  # noqa: A001
    known = gym.registry.get(id)
    if known is None:
        _register(task, id)
    elif (known.entry_point, known.kwargs) != (_ENV, {"task": task}):
        raise ValueError(f"Gymnasium id {id!r} is already registered; choose another.")
    return id


def _register(task: str, name: str) -> None:
    # No `max_episode_steps`: Gymnasium's TimeLimit would count calls of step(), not control steps.
    gym.register(
        id=name,
        entry_point=_ENV,
        vector_entry_point="pixelbrax_gym.gymnasium.vector_env:GymnasiumVectorEnv",
        kwargs={"task": task},
        # Gymnasium's checker warns of observations that are no NumPy arrays.
        disable_env_checker=True,
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
