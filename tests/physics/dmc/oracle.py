"""DM Control itself: states of its random-action episodes, and what it makes of them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

# Nothing is drawn, and importing must not look for a display.
os.environ.setdefault("MUJOCO_GL", "disable")


@dataclass(frozen=True)
class Transitions:
    """N states of DM Control, and the control steps from them. All arrays are float64.

    Attributes:
        before, after: name -> (N, ...) what ``record`` reads of the states.
        action: (N, A) actions between them, in the model's control ranges.
    """

    before: dict[str, np.ndarray]
    action: np.ndarray
    after: dict[str, np.ndarray]


def load(task: str, seed: int = 0) -> Any:
    """DM Control's environment of one of our tasks."""
    from dm_control import suite

    from pixelbrax_jax.tasks import DMC_TASKS

    row = DMC_TASKS[task]
    return suite.load(row.domain, row.task, task_kwargs={"random": seed})


def target_of(physics: Any) -> np.ndarray:
    """(3,) where the model has its target; (0,) without one."""
    for names, positions in (
        (physics.named.model.geom_pos.axes.row.names, physics.named.model.geom_pos),
        (physics.named.model.site_pos.axes.row.names if physics.model.nsite else [], None),
    ):
        if "target" in names:
            positions = physics.named.model.site_pos if positions is None else positions
            return np.array(positions["target"])
    return np.zeros(0)


def flatten(observation: Any) -> np.ndarray:
    """DM Control's observation as one vector, in its order."""
    return np.concatenate([np.ravel(part) for part in observation.values()])


def record(env: Any, reward: float, observation: Any) -> dict[str, np.ndarray]:
    """What of a state is compared."""
    data = env.physics.data
    fields = ("qpos", "qvel", "act", "qacc_warmstart", "ctrl", "sensordata", "xpos")
    return {
        **{name: np.array(getattr(data, name)) for name in fields},
        "target": target_of(env.physics),
        "reward": np.array(reward),
        "obs": flatten(observation),
    }


@cache
def transitions(task: str, count: int, *, episodes: int = 4, seed: int = 0) -> Transitions:
    """Draw states from episodes of random actions, evenly along them."""
    env = load(task, seed)
    spec = env.action_spec()
    random = np.random.RandomState(seed + 1)
    every = max(1, 1000 * episodes // count)
    before, after, actions = [], [], []
    for _ in range(episodes):
        step = env.reset()
        for number in range(1000):
            state = record(env, step.reward or 0.0, step.observation) if number else None
            action = random.uniform(spec.minimum, spec.maximum)
            step = env.step(action)
            if number and number % every == every // 2 % every or (every == 1 and number):
                before.append(state)
                actions.append(action)
                after.append(record(env, step.reward, step.observation))
    return Transitions(_stack(before[:count]), np.array(actions[:count]), _stack(after[:count]))


def _stack(rows: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}
