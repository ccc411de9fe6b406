"""DM Control itself: states of its random-action episodes, and what it makes of them."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from pixelbrax_jax.tasks import DMC_TASKS

# Nothing is drawn, and importing must not look for a display.
os.environ.setdefault("MUJOCO_GL", "disable")

_FIELDS = ("qpos", "qvel", "act", "qacc_warmstart", "ctrl", "sensordata", "xpos")


@dataclass(frozen=True)
class Transitions:
    """N states of DM Control, and the control steps from them. All arrays are float64.

    Attributes:
        before, after: name -> (N, ...), what ``record`` reads of the states.
        action: (N, A) actions between them, in the actuators' control ranges.
    """

    before: dict[str, np.ndarray]
    action: np.ndarray
    after: dict[str, np.ndarray]


def load(task: str, seed: int = 0) -> Any:
    """DM Control's environment of one of our tasks."""
    with warnings.catch_warnings():
        # Of its own, and of what it imports.
        warnings.simplefilter("ignore")
        from dm_control import suite

        row = DMC_TASKS[task]
        return suite.load(row.domain, row.task, task_kwargs={"random": seed})


def target_of(physics: Any) -> np.ndarray:
    """(3,) where the model has its target, (7,) the pose of one that is a body; (0,) without."""
    model = physics.model
    if "target_ball" in [model.body(i).name for i in range(model.nbody)]:
        body = model.body("target_ball")
        return np.concatenate([body.pos, body.quat])
    for kind, count, places in (
        ("geom", model.ngeom, model.geom_pos),
        ("site", model.nsite, model.site_pos),
    ):
        names = [model.id2name(i, kind) for i in range(count)]
        if "target" in names:
            return np.array(places[names.index("target")])
    return np.zeros(0)


def flatten(observation: Any) -> np.ndarray:
    """DM Control's observation as one vector, in its order."""
    return np.concatenate([np.ravel(part) for part in observation.values()])


def record(env: Any, timestep: Any) -> dict[str, np.ndarray]:
    """What of a state is compared."""
    data = env.physics.data
    return {
        **{name: np.array(getattr(data, name)) for name in _FIELDS},
        "target": target_of(env.physics),
        "reward": np.array(timestep.reward or 0.0),
        "obs": flatten(timestep.observation),
    }


@cache
def transitions(
    task: str, count: int, *, episodes: int = 4, length: int = 1000, seed: int = 0
) -> Transitions:
    """Take states from episodes of random actions, evenly along them, never the first."""
    env = load(task, seed)
    spec = env.action_spec()
    random = np.random.RandomState(seed + 1)
    chosen = set(np.linspace(1, length - 1, -(-count // episodes)).astype(int).tolist())
    before, after, actions = [], [], []
    for _ in range(episodes):
        timestep = env.reset()
        for number in range(length):
            action = random.uniform(spec.minimum, spec.maximum)
            if number in chosen:
                before.append(record(env, timestep))
                actions.append(action)
            timestep = env.step(action)
            if number in chosen:
                after.append(record(env, timestep))
    return Transitions(_stack(before[:count]), np.array(actions[:count]), _stack(after[:count]))


def episode(task: str, length: int, seed: int = 0) -> Transitions:
    """Make the transitions of an episode of random actions, from its initial state on."""
    env = load(task, seed)
    spec = env.action_spec()
    random = np.random.RandomState(seed + 1)
    actions = random.uniform(spec.minimum, spec.maximum, (length, *spec.shape))
    seen = [record(env, env.reset())]
    seen += [record(env, env.step(action)) for action in actions]
    return Transitions(_stack(seen[:-1]), actions, _stack(seen[1:]))


@cache
def starts(task: str, count: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Initial states of episodes."""
    env = load(task, seed)
    return _stack([record(env, env.reset()) for _ in range(count)])


def _stack(rows: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}
