"""Our tasks of Gymnasium's do what Gymnasium's do, which is asked itself."""

from __future__ import annotations

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax.physics.gym.tasks import TASKS
from pixelbrax_jax.physics.mujoco.dynamics import Readings, State
from pixelbrax_jax.physics.mujoco.formulas import Snapshot
from pixelbrax_jax.registry import make_physics


def record(env):
    data = env.unwrapped.data
    names = ("qpos", "qvel", "act", "qacc_warmstart", "ctrl", "xpos", "xipos")
    return {name: np.array(getattr(data, name)) for name in names}


def transitions(task, num_steps, seed=0):
    """States of Gymnasium's episodes with random actions, actions, and what a step gives."""
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
    stack = lambda rows: {name: np.stack([row[name] for row in rows]) for name in rows[0]}  # noqa: E731
    return stack(before), np.stack(actions), stack(after)


def states_of(physics, rows):
    """States of Gymnasium as a batch of ours."""

    def one(qpos, qvel, act, warmstart, ctrl, xpos, xipos):
        state = State(qpos, qvel, act, warmstart, ctrl, jnp.zeros(0), jnp.zeros(0))
        fields = {"xpos": xpos, "xipos": xipos}
        readings = Readings(xpos, None, None, jnp.zeros_like(qpos), fields)
        remember = physics._formulas.remember
        return state.replace(remembered=remember(Snapshot(physics._model, state, readings)))

    return jax.jit(jax.vmap(one))(*(jnp.asarray(x, jnp.float32) for x in rows.values()))


@pytest.mark.parametrize("task", TASKS)
def test_a_step_has_the_same_observation_reward_and_end(task):
    physics = make_physics(task)
    before, actions, after = transitions(task, 1000)
    low, high = physics._control_range
    actions = jnp.asarray(2 * (actions - low) / (high - low) - 1, jnp.float32)
    step = jax.jit(jax.vmap(lambda state, action: physics.observe(*physics.move(state, action))))
    ours = step(states_of(physics, before), actions)
    np.testing.assert_array_equal(ours.terminated, after["terminated"])
    scale = np.maximum(1, np.abs(after["obs"]))
    print(
        task,
        "obs",
        np.max(np.abs(ours.obs - after["obs"]) / scale),
        "reward",
        np.max(np.abs(ours.reward - after["reward"]) / np.maximum(1, np.abs(after["reward"]))),
        "terminated",
        int(after["terminated"].sum()),
    )
    assert np.max(np.abs(ours.obs - after["obs"]) / scale) < 1e-3
    reward = after["reward"]
    assert np.max(np.abs(ours.reward - reward) / np.maximum(1, np.abs(reward))) < 1e-5
