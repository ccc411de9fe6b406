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
_PAPER = {"num_policy_phases": 32, "aux_minibatches": 512, "aux_epochs": 6}
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

# The settings of DrQ-v2's code; the classes' defaults have the rest.
_DRQV2 = {
    "look": "dmc",
    "action_repeat": 2,
    "num_envs": 1,
    "num_steps": 2,
    "buffer_size": 1_000_000,
    "saturation_coef": 0.0,
}
# For many environments, small images and few updates, after Squint (arXiv 2602.21203).
_SMALL_DRQV2 = {
    "height": 32,
    "width": 32,
    "action_repeat": 2,
    "learning_rate": 3e-4,
    "random_shift": 2,
}

PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    # The defaults of each class.
    "default": {name: {} for name in ALGORITHMS},
    # Garcin et al.'s scripts for Brax (deac-rep, the code behind arXiv 2502.00021).
    "deacrep": {
        "ppo": _DEACREP | {"update_epochs": 1},
        "ppg": _DEACREP | {"aux_epochs": 1, "vf_coef": 0.5},
        "dcpg": _DEACREP | {"aux_epochs": 1, "decoupled": True},
    },
    # Moon et al. for Procgen (arXiv 2210.09960), and Cobbe et al. for PPG (arXiv 2009.04416).
    "procgen": {
        "ppo": _PROCGEN | {"layout": "shared", "clip_value": True},
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
        "drqv2": _SMALL_DRQV2
        | {
            "samples": 4,
            "encoder": "patch2",
            "num_steps": 4,
            "batch_size": 128,
            "hidden_dim": 128,
            "layer_norm": True,
            "replay_ratio": 0.25,
            "std_steps": 75_000,
            "buffer_size": 250_000,
            "total_steps": 500_000,
        },
    },
    # Yarats et al. for the DM Control Suite (the code of arXiv 2107.09645).
    "drqv2": {"drqv2": _DRQV2 | {"task": "dmc_cartpole_swingup"}},
    # For a GPU.
    "fast": {
        "drqv2": _SMALL_DRQV2
        | {
            "encoder": "small",
            "replay_ratio": 0.125,
            "num_envs": 256,
            "batch_size": 512,
            "learning_starts": 10_000,
            "buffer_size": 1_000_000,
            "std_steps": 500_000,
            "hidden_dim": 512,
            "bfloat16": True,
            "total_steps": 4_000_000,
        },
    },
}
"""Changes to the defaults, by preset and algorithm."""

_CPU_TASKS: dict[str, dict[str, Any]] = {
    "halfcheetah": {"action_repeat": 2, "gamma": 0.97, "total_steps": 3_100_000},
    # With Brax's reward the walker stands and hardly walks; see docs/results.md.
    "walker2d": {"reward_preset": "paper", "action_repeat": 4, "total_steps": 6_800_000},
    # Brax subtracts half of each squared action: noise of 0.5 costs Ant its reward for staying up.
    "ant": {"initial_std": 0.25, "action_repeat": 2, "gamma": 0.97, "total_steps": 3_400_000},
    "humanoid": {"action_repeat": 3, "gamma": 0.98, "total_steps": 3_500_000},
}
# Tasks of the DM Control Suite, only for PPO.
_CPU_MUJOCO_TASKS: dict[str, dict[str, Any]] = {
    "dmc_cartpole_swingup": {
        "action_repeat": 8,
        "frame_stack": 3,
        "gamma": 0.98,
        "update_epochs": 3,
        "total_steps": 6_000_000,
    },
    # With less initial noise, one of two seeds reaches only half of the targets.
    "dmc_reacher_easy": {
        "action_repeat": 4,
        "gamma": 0.97,
        "initial_std": 1.0,
        "update_epochs": 3,
        "total_steps": 3_000_000,
    },
    "dmc_ball_in_cup_catch": {
        "action_repeat": 4,
        "frame_stack": 3,
        "gamma": 0.98,
        "update_epochs": 3,
        "total_steps": 3_000_000,
    },
    "gym_halfcheetah": {
        "action_repeat": 2,
        "gamma": 0.97,
        "update_epochs": 3,
        "total_steps": 3_000_000,
    },
}
# In 32 x 32 pixels the pole moves by less than a pixel in two control steps. PlaNet's and DrQ's
# action repeat of 8 makes its velocity visible; the updates are as many as elsewhere. A policy that
# never saw the stars and the reflection of dm_control's picture loses return there.
_CPU_CARTPOLE = {"look": "dmc", "action_repeat": 8, "replay_ratio": 1.0, "std_steps": 20_000}
# Fewer rays per pixel learn to balance later. With a constant step size returns jump by hundreds
# from one evaluation to the next.
_CPU_BALANCE = _CPU_CARTPOLE | {"samples": 16, "anneal": True}
_CPU_DRQV2_TASKS: dict[str, dict[str, Any]] = {
    "dmc_cartpole_balance": _CPU_BALANCE,
    "dmc_cartpole_balance_sparse": _CPU_BALANCE,
    "dmc_cartpole_swingup": _CPU_CARTPOLE,
    "dmc_cartpole_swingup_sparse": _CPU_CARTPOLE,
    "dmc_finger_spin": {"look": "dmc"},
    "dmc_walker_walk": {"look": "dmc"},
    "halfcheetah": {"backend": "spring"},
}
_CPU_SHARES = {"ppo": 1.0, "ppg": 0.7, "dcpg": 0.6}
"""Number of steps relative to PPO, whose updates are faster."""

_DRQV2_TASKS = (
    # total_steps, std_steps, tasks
    (
        1_100_000,
        100_000,
        "ball_in_cup_catch cartpole_balance cartpole_balance_sparse cartpole_swingup finger_spin "
        "hopper_stand pendulum_swingup walker_stand walker_walk",
    ),
    (
        3_100_000,
        500_000,
        "acrobot_swingup cartpole_swingup_sparse cheetah_run finger_turn_easy finger_turn_hard "
        "hopper_hop quadruped_run quadruped_walk reacher_easy reacher_hard walker_run",
    ),
    (30_100_000, 2_000_000, "humanoid_run humanoid_stand humanoid_walk"),
)


def _drqv2_settings(task: str) -> dict[str, Any]:
    """Return what DrQ-v2's code changes for a task besides its length and schedule."""
    if task.startswith("walker"):
        return {"batch_size": 512, "n_step": 1}
    if task.startswith("humanoid"):
        return {"feature_dim": 100, "learning_rate": 8e-5}
    return {"buffer_size": 100_000} if task == "quadruped_run" else {}


TASK_SETTINGS: dict[str, dict[str, dict[str, dict[str, Any]]]] = {
    "cpu": {
        algorithm: {
            task: settings
            | {"backend": "spring", "total_steps": int(share * settings["total_steps"])}
            for task, settings in _CPU_TASKS.items()
        }
        | (_CPU_MUJOCO_TASKS if algorithm == "ppo" else {})
        for algorithm, share in _CPU_SHARES.items()
    }
    | {"drqv2": _CPU_DRQV2_TASKS},
    "drqv2": {
        "drqv2": {
            f"dmc_{task}": {"total_steps": total, "std_steps": over} | _drqv2_settings(task)
            for total, over, tasks in _DRQV2_TASKS
            for task in tasks.split()
        }
    },
}
"""Further changes, by preset, algorithm and task. If a preset has no length (``total_steps``) of
its own, other tasks are errors."""


def preset_names(algorithm: str) -> list[str]:
    """Return the names of the presets that have settings for an algorithm."""
    return [name for name, settings in PRESETS.items() if algorithm in settings]


def check_preset(algorithm: str, name: str) -> None:
    """Raise a ValueError unless a preset of this name has settings for an algorithm."""
    if name in list(PRESETS) and algorithm not in PRESETS[name]:
        raise ValueError(
            f"the preset {name!r} has no settings for {algorithm}; use one of "
            f"{', '.join(preset_names(algorithm))}."
        )
    check_choice("preset", name, preset_names(algorithm))


def preset(
    algorithm: str, name: str = "default", task: str | None = None, **changes: Any
) -> TrainConfig:
    """Return the settings of a preset, with ``changes`` as in ``TrainConfig.replace``.

    The algorithm is ``"ppo"``, ``"ppg"``, ``"dcpg"`` or ``"drqv2"``; the name is one of
    ``PRESETS`` that has the algorithm. ``task=None`` uses the preset's task.

    Raises:
        ValueError: a name is unknown, a setting is out of range, or the preset lacks the algorithm
            or the task.
    """
    check_choice("algorithm", algorithm, ALGORITHMS)
    check_preset(algorithm, name)
    kind, settings = ALGORITHMS[algorithm].config_class, PRESETS[name][algorithm]
    if task is not None:
        settings = settings | {"task": task}
    if of_tasks := TASK_SETTINGS.get(name, {}).get(algorithm):
        task = settings.get("task", kind().env.task)
        if task not in of_tasks and "total_steps" not in settings:
            raise ValueError(
                f"the preset {name!r} has no settings for task {task!r}; use preset 'default', or "
                f"one of its tasks: {', '.join(sorted(of_tasks))}.{suggest(task, of_tasks)}"
            )
        settings = settings | of_tasks.get(task, {})
    return kind().replace(**settings | changes)
