"""How far our tasks of Gymnasium's are from Gymnasium's.

Write the figures into ``docs/gym/physics.json``: ``python -m tests.physics.gym.measure``.
"""

from __future__ import annotations

import argparse
import json
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from pixelbrax_jax.physics.gym.tasks import TASKS
from pixelbrax_jax.physics.mujoco.dynamics import Readings, State
from pixelbrax_jax.physics.mujoco.formulas import Snapshot
from pixelbrax_jax.registry import make_physics

RESULTS = Path(__file__).parents[3] / "docs" / "gym" / "physics.json"


def control_step(task: str, num_steps: int) -> dict[str, float]:
    """Largest differences after a control step from Gymnasium's states, of random actions.

    Numbers above 1 are compared relatively.
    """
    physics = make_physics(task)
    before, actions, after = transitions(task, num_steps)
    low, high = physics._control_range
    actions = jnp.asarray(2 * (actions - low) / (high - low) - 1, jnp.float32)
    step = jax.jit(jax.vmap(lambda state, action: physics.observe(*physics.move(state, action))))
    ours = step(states_of(physics, before), actions)
    return {
        "observation": _largest(ours.obs, after["obs"]),
        "reward": _largest(ours.reward, after["reward"]),
        "flags_off": int((np.asarray(ours.terminated) != after["terminated"]).sum()),
        "ends": int(after["terminated"].sum()),
    }


def initial_states(task: str, episodes: int, seed: int = 0) -> dict[str, float]:
    """p values of Kolmogorov and Smirnov's test, by coordinate, of both sides' first observations.

    A coordinate that is the same number in all of Gymnasium's episodes has p 1 if it is in ours,
    else 0.
    """
    env = gymnasium.make(TASKS[task].original)
    theirs = np.stack([env.reset(seed=seed + i)[0] for i in range(episodes)])
    env.close()
    keys = jax.random.split(jax.random.key(seed), episodes)
    ours = np.asarray(_reset(task)(keys).obs, np.float64)
    p_values = {}
    for i, (mine, other) in enumerate(zip(ours.T, theirs.T, strict=True)):
        if np.ptp(other) < 1e-6 * max(1.0, np.abs(other).max()):
            p = float(np.allclose(mine, other[0], atol=1e-5))
        else:
            p = float(stats.ks_2samp(mine, other).pvalue)
        p_values[f"obs[{i}]"] = p
    return p_values


@cache
def _reset(task: str) -> Any:
    return jax.jit(jax.vmap(make_physics(task).reset))


def record(env: gymnasium.Env) -> dict[str, np.ndarray]:
    """Return what our states are made of."""
    data = env.unwrapped.data
    names = ("qpos", "qvel", "act", "qacc_warmstart", "ctrl", "xpos", "xipos")
    return {name: np.array(getattr(data, name)) for name in names}


def transitions(task: str, num_steps: int, seed: int = 0) -> tuple[Any, Any, Any]:
    """Return states of Gymnasium's episodes with random actions, actions, and what a step gives."""
    env = gymnasium.make(TASKS[task].original)
    env.action_space.seed(seed)
    env.reset(seed=seed)
    before, actions, after = [], [], []
    for _ in range(num_steps):
        # Our states are float32 between control steps.
        for name in ("qpos", "qvel", "qacc_warmstart"):
            array = getattr(env.unwrapped.data, name)
            array[:] = array.astype(np.float32)
        before.append(record(env))
        action = env.action_space.sample()
        obs, reward, terminated, truncated, _ = env.step(action)
        actions.append(action)
        after.append(record(env) | {"obs": obs, "reward": reward, "terminated": terminated})
        if terminated or truncated:
            env.reset()
    env.close()
    return _stack(before), np.stack(actions), _stack(after)


def _stack(rows: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def states_of(physics: Any, rows: dict[str, np.ndarray]) -> State:
    """Return states of Gymnasium as a batch of ours."""

    def one(qpos, qvel, act, warmstart, ctrl, xpos, xipos):  # type: ignore[no-untyped-def]
        state = State(qpos, qvel, act, warmstart, ctrl, *3 * [jnp.zeros(0)])
        fields = {"xpos": xpos, "xipos": xipos}
        readings = Readings(xpos, None, None, jnp.zeros_like(qpos), fields)
        remember = physics._formulas.remember
        return state.replace(remembered=remember(Snapshot(physics._model, state, readings)))

    return jax.jit(jax.vmap(one))(*(jnp.asarray(x, jnp.float32) for x in rows.values()))


def _largest(ours: Any, theirs: np.ndarray) -> float:
    errors = np.abs(np.asarray(ours) - theirs) / np.maximum(1.0, np.abs(theirs))
    return float(errors.max())


def main() -> None:
    """Measure all tasks."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    versions = {name: metadata.version(name) for name in ("gymnasium", "mujoco", "jax")}
    found = {}
    for task in TASKS:
        p_values = initial_states(task, 500)
        found[task] = {
            "states": 1000,
            "control_step": control_step(task, 1000),
            "initial_states": {"episodes": 500, "lowest_p": min(p_values.values())},
        }
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"tasks": found, "versions": versions}, indent=1, sort_keys=True)
    RESULTS.write_text(text + "\n", "utf-8")


if __name__ == "__main__":
    main()
