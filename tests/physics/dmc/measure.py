"""How far our tasks of the DM Control Suite are from DM Control's.

Write the figures of some tasks, or of all, into ``docs/dmc/physics.json``::

    python -m tests.physics.dmc.measure [task ...]
"""

from __future__ import annotations

import argparse
import json
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy import stats

from pixelbrax_jax.physics.mujoco.dynamics import State
from pixelbrax_jax.registry import make_physics
from pixelbrax_jax.tasks import DMC_TASKS
from tests.physics.dmc import oracle

RESULTS = Path(__file__).parents[3] / "docs" / "dmc" / "physics.json"

STATES = 200
EPISODES = 500
LENGTH = 1000


def same_state(task: str, count: int) -> dict[str, float]:
    """Largest differences of what both sides say of the same states.

    Observations are compared as they are where they are below 1, and relatively above: float32 has
    seven digits.
    """
    states = oracle.transitions(task, count).before
    physics, state = make_physics(task), _ours(task, states)
    readings = jax.jit(jax.vmap(physics.dynamics.first))(state)
    # Forces are those of the last step, which only DM Control has made.
    is_force = physics._model.sensor_needstage == int(mujoco.mjtStage.mjSTAGE_ACC)
    is_force = np.repeat(is_force, physics._model.sensor_dim)
    sensors = jnp.where(is_force, states["sensordata"], readings.sensordata)
    ours = _look(task)(state, readings.replace(sensordata=sensors))
    return {
        "reward": _largest(ours.reward - states["reward"]),
        "observation": _largest(_relative(ours.obs, states["obs"])),
        "links": _largest(ours.xpos[:, : states["xpos"].shape[1] - 1] - states["xpos"][:, 1:]),
    }


def control_step(task: str, count: int, **episodes: int) -> dict[str, float]:
    """Differences after one control step from the same states, likewise."""
    drawn = oracle.transitions(task, count, **episodes)
    physics = make_physics(task)
    low, high = physics._control_range
    action = jnp.asarray(2 * (drawn.action - low) / (high - low) - 1, jnp.float32)
    state = _ours(task, drawn.before)
    after = _look(task)(*jax.jit(jax.vmap(physics.move))(state, action))
    velocity = _relative(after.engine.qvel, drawn.after["qvel"]).max(axis=1)
    reward = np.abs(np.asarray(after.reward) - drawn.after["reward"])
    return {
        "reward": _largest(reward),
        "rewards_off": int((reward > 1e-4).sum()),
        "velocity": _largest(velocity),
        "velocity_median": float(np.median(velocity)),
        "velocities_off": int((velocity > 1e-2).sum()),
        "observation": _largest(_relative(after.obs, drawn.after["obs"])),
    }


def episode(task: str, length: int) -> dict[str, Any]:
    """Compare an episode of both sides, from the same state with the same random actions.

    ``apart`` is the number of control steps after which a joint position differs by 0.01, if any.
    """
    theirs = oracle.episode(task, length)
    physics = make_physics(task)
    low, high = physics._control_range
    actions = jnp.asarray(2 * (theirs.action - low) / (high - low) - 1, jnp.float32)
    state = jax.tree.map(lambda x: x[0], _ours(task, theirs.before))

    def step(state: State, action: jax.Array) -> tuple[State, tuple[jax.Array, jax.Array]]:
        after = physics.observe(*physics.move(state, action))
        return after.engine, (after.engine.qpos, after.reward)

    start = physics.observe(state, jax.jit(physics.dynamics.first)(state)).engine
    qpos, rewards = jax.jit(lambda start: jax.lax.scan(step, start, actions))(start)[1]
    far = _relative(qpos, theirs.after["qpos"]).max(axis=1) > 1e-2
    return {
        "apart": int(np.argmax(far)) + 1 if far.any() else None,
        "return": float(np.sum(rewards)),
        "return_of_dm_control": float(theirs.after["reward"].sum()),
    }


def initial_states(task: str, episodes: int, seed: int = 0) -> dict[str, float]:
    """p values of Kolmogorov and Smirnov's test, by coordinate, of both sides' initial states.

    A coordinate that is the same number in all of DM Control's episodes has p 1 if it is in ours,
    else 0.
    """
    theirs = oracle.starts(task, episodes, seed)
    keys = jax.random.split(jax.random.key(seed), episodes)
    ours = _look(task)(*_first(task)(keys))
    pairs = {
        "qpos": (ours.engine.qpos, theirs["qpos"]),
        "qvel": (ours.engine.qvel, theirs["qvel"]),
        "obs": (ours.obs, theirs["obs"]),
    }
    if ours.engine.target.shape[1]:
        pairs["target"] = (ours.engine.target, theirs["target"])
    return {
        f"{name}[{i}]": _agreement(np.asarray(mine[:, i], np.float64), other[:, i])
        for name, (mine, other) in pairs.items()
        for i in range(other.shape[1])
    }


def _agreement(ours: np.ndarray, theirs: np.ndarray) -> float:
    # What DM Control leaves at a constant, rounding apart; forces that cancel out are tens of
    # newtons.
    if np.ptp(theirs) < 1e-6 * max(1.0, np.abs(theirs).max()):
        return float(np.allclose(ours, theirs[0], atol=1e-4, rtol=1e-5))
    return float(stats.ks_2samp(ours, theirs).pvalue)


def _ours(task: str, states: dict[str, np.ndarray]) -> State:
    """States of DM Control as a batch of ours."""
    names = ("qpos", "qvel", "act", "qacc_warmstart", "ctrl", "target")
    fields = {name: jnp.asarray(states[name], jnp.float32) for name in names}
    physics = make_physics(task)
    start = jax.eval_shape(physics.first, jax.random.key(0))[0]
    fields["target"] = fields["target"][:, : start.target.size]
    nothing = jnp.zeros((len(fields["qpos"]), 0))
    return State(**fields, multipliers=nothing, remembered=nothing)


@cache
def _first(task: str) -> Any:
    return jax.jit(jax.vmap(make_physics(task).first))


@cache
def _look(task: str) -> Any:
    """Return a program of states and readings, for what our side says of them."""
    return jax.jit(jax.vmap(make_physics(task).observe))


def _relative(ours: Any, theirs: np.ndarray) -> np.ndarray:
    return np.abs(np.asarray(ours) - theirs) / np.maximum(1.0, np.abs(theirs))


def _largest(errors: Any) -> float:
    return float(np.abs(np.asarray(errors)).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="*", default=list(DMC_TASKS))
    parser.add_argument("--states", type=int, default=STATES)
    parser.add_argument("--episodes", type=int, default=EPISODES)
    arguments = parser.parse_args()
    known = json.loads(RESULTS.read_text("utf-8")) if RESULTS.exists() else {"tasks": {}}
    known["versions"] = {
        name: metadata.version(name) for name in ("dm_control", "mujoco", "mujoco-mjx", "jax")
    }
    for task in arguments.tasks:
        p_values = initial_states(task, arguments.episodes)
        worst = min(p_values, key=lambda name: p_values[name])
        known["tasks"][task] = {
            "states": arguments.states,
            "same_state": same_state(task, arguments.states),
            "control_step": control_step(task, arguments.states),
            "episode": episode(task, LENGTH),
            "initial_states": {
                "episodes": arguments.episodes,
                "coordinates": len(p_values),
                "lowest_p": p_values[worst],
                "of": worst,
            },
        }
        RESULTS.parent.mkdir(parents=True, exist_ok=True)
        RESULTS.write_text(json.dumps(known, indent=1, sort_keys=True) + "\n", "utf-8")
        jax.clear_caches()


if __name__ == "__main__":
    main()
