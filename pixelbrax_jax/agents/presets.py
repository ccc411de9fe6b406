"""Presets: named settings of each algorithm."""

from __future__ import annotations

from typing import Any

from pixelbrax_jax.agents.config import TrainConfig
from pixelbrax_jax.agents.registry import ALGORITHMS
from pixelbrax_jax.validation import check_choice, suggest

_DEACREP = {
    "backend": "spring",
    "height": 64,
    "width": 64,
    "num_envs": 32,
    "num_steps": 32,
    "policy": "deacrep",
    "gamma": 0.999,
    "learning_rate": 5e-4,
    "adam_eps": 1e-8,
    "ent_coef": 0.01,
    "normalize_reward": False,
}
_PROCGEN = {
    "height": 64,
    "width": 64,
    "frame_stack": 1,
    "num_envs": 64,
    "num_steps": 256,
    "gamma": 0.999,
    "learning_rate": 5e-4,
    "ent_coef": 0.01,
}
_PAPER = {"num_policy_phases": 32, "aux_minibatches": 32, "aux_epochs": 6}
_FAST = {
    "frame_stack": 2,
    "num_steps": 32,
    "learning_rate": 1e-3,
    "anneal": True,
    "ent_coef": 0.0,
}
_CI = _FAST | {
    "task": "inverted_pendulum",
    "height": 32,
    "width": 32,
    "num_envs": 128,
    "total_steps": 1_400_000,
    "encoder": "small",
    "initial_std": 0.37,
}
_CPU = _FAST | {
    "height": 48,
    "width": 48,
    "encoder": "patch",
    "num_envs": 64,
    "num_minibatches": 16,
    "initial_std": 0.5,
}
_PPG = {"layout": "detach", "aux_epochs": 1}
_DCPG = {"num_policy_phases": 2, "aux_epochs": 2, "update_epochs": 2}

PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    # The defaults of each class.
    "default": {},
    # Lyu et al.'s scripts for Brax (the code of arXiv 2502.00021).
    "deacrep": {
        "ppo": _DEACREP | {"update_epochs": 1},
        "ppg": _DEACREP | {"aux_epochs": 1, "vf_coef": 0.5},
        "dcpg": _DEACREP | {"aux_epochs": 1, "decoupled": True},
    },
    # Moon et al. for Procgen (arXiv 2210.09960), and Cobbe et al. for PPG (arXiv 2009.04416).
    "procgen": {
        "ppo": _PROCGEN | {"clip_value": True},
        "ppg": _PROCGEN | _PAPER | {"adam_eps": 1e-8, "max_grad_norm": 0.0},
        "dcpg": _PROCGEN | _PAPER,
    },
    # Takes minutes on two CPU cores.
    "ci": {
        "ppo": _CI | {"layout": "shared", "update_epochs": 3},
        "ppg": _CI
        | _PPG
        | {"policy_epochs": 3, "value_epochs": 3, "num_policy_phases": 8, "aux_minibatches": 8},
        "dcpg": _CI | _DCPG | {"aux_minibatches": 8},
    },
    # Takes 6 to 9 minutes on two CPU cores; see docs/results.md.
    "cpu": {
        "ppo": _CPU | {"layout": "shared", "update_epochs": 2},
        "ppg": _CPU | _PPG | {"policy_epochs": 2, "value_epochs": 2, "num_policy_phases": 2},
        "dcpg": _CPU | _DCPG,
    },
}
"""Changes to the defaults, by preset and algorithm."""

_CPU_TASKS: dict[str, dict[str, Any]] = {
    "halfcheetah": {"action_repeat": 2, "gamma": 0.97, "total_steps": 3_100_000},
    # With Brax's reward the walker stands and hardly walks; see docs/results.md.
    "walker2d": {"reward_preset": "paper", "action_repeat": 4, "total_steps": 6_800_000},
    # Brax's reward subtracts half of each squared action, so noise of 0.5 costs Ant its reward for
    # staying up.
    "ant": {"initial_std": 0.25, "action_repeat": 2, "gamma": 0.97, "total_steps": 3_400_000},
    "humanoid": {"action_repeat": 3, "gamma": 0.98, "total_steps": 3_500_000},
}
# Tasks of the DM Control Suite, only for PPO.
_CPU_DMC_TASKS: dict[str, dict[str, Any]] = {
    "dmc_cartpole_swingup": {
        "action_repeat": 8,
        "frame_stack": 3,
        "gamma": 0.98,
        "update_epochs": 3,
        "total_steps": 6_000_000,
    },
    "dmc_reacher_easy": {
        "action_repeat": 4,
        "gamma": 0.97,
        "update_epochs": 3,
        "total_steps": 3_000_000,
    },
}
_CPU_SHARES = {"ppo": 1.0, "ppg": 0.7, "dcpg": 0.6}
"""Number of steps relative to PPO, whose updates are faster."""

TASK_SETTINGS: dict[str, dict[str, dict[str, dict[str, Any]]]] = {
    "cpu": {
        algorithm: {
            task: settings
            | {"backend": "spring", "total_steps": int(share * settings["total_steps"])}
            for task, settings in _CPU_TASKS.items()
        }
        | (_CPU_DMC_TASKS if algorithm == "ppo" else {})
        for algorithm, share in _CPU_SHARES.items()
    },
}
"""Further changes, by preset, algorithm and task; these presets support no other tasks."""


def preset(
    algorithm: str, name: str = "default", task: str | None = None, **changes: Any
) -> TrainConfig:
    """Return the settings of a preset, with ``changes`` as in ``TrainConfig.replace``.

    The algorithm is ``"ppo"``, ``"ppg"`` or ``"dcpg"``; the name is ``"default"``, ``"deacrep"``,
    ``"procgen"``, ``"ci"`` or ``"cpu"``. ``task=None`` uses the preset's task.

    Raises:
        ValueError: a name is unknown, a setting is out of range, or the preset lacks the task.
    """
    check_choice("algorithm", algorithm, ALGORITHMS)
    check_choice("preset", name, PRESETS)
    kind, settings = ALGORITHMS[algorithm].config_class, PRESETS[name].get(algorithm, {})
    if task is not None:
        settings = settings | {"task": task}
    if of_tasks := TASK_SETTINGS.get(name, {}).get(algorithm):
        task = settings.get("task", kind().env.task)
        if task not in of_tasks:
            raise ValueError(
                f"the preset {name!r} has no settings for task {task!r}; use preset 'default', or "
                f"one of its tasks: {', '.join(sorted(of_tasks))}.{suggest(task, of_tasks)}"
            )
        settings = settings | of_tasks[task]
    return kind().replace(**settings | changes)
