"""Environments of MuJoCo Playground as tasks: its states, rewards and ends."""

from __future__ import annotations

import jax
import mujoco
import numpy as np
import pytest

import pixelbrax_jax as pb
from pixelbrax_jax.physics.mujoco.compatibility import import_silenced
from pixelbrax_jax.physics.mujoco.playground import playground_physics

with import_silenced():
    from mujoco_playground import registry


@pytest.mark.parametrize("name", ["CartpoleBalance", "HopperHop"])
def test_episodes_are_playgrounds(name):
    physics = playground_physics(name)
    env = registry.load(name, config_overrides={"impl": "jax"})
    actions = jax.random.uniform(jax.random.key(1), (20, env.action_size), minval=-1.0)
    # The same program twice, so that XLA rounds alike.
    options = {"xla_backend_optimization_level": 0}

    def ours(key):
        def step(state, action):
            state = physics.step(state, action)
            return state, (state.obs, state.reward, state.terminated, state.xpos, state.engine)

        return jax.lax.scan(step, physics.reset(key), actions)[1]

    def theirs(key):
        def step(state, action):
            state = env.step(state, action)
            return state, (state.obs, state.reward, state.done > 0.5)

        return jax.lax.scan(step, env.reset(jax.random.key_data(key)), actions)[1]

    key = jax.random.key(3)
    *found, xpos, engine = jax.jit(ours, compiler_options=options)(key)
    for one, other in zip(found, jax.jit(theirs, compiler_options=options)(key), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)
    data = mujoco.MjData(env.mj_model)
    data.qpos = engine.data.qpos[-1]
    mujoco.mj_kinematics(env.mj_model, data)
    np.testing.assert_allclose(xpos[-1, : data.xpos.shape[0] - 1], data.xpos[1:], atol=1e-5)


def test_one_line_makes_a_task():
    pb.register("balance", lambda: pb.playground_physics("CartpoleBalance"))
    env, params = pb.make("balance", height=16, width=16)
    assert params.episode_length == 1000
    pb.check_env(env, params)


def test_an_unknown_name():
    with pytest.raises(ValueError, match="'CartpoleBalanc' not found"):
        playground_physics("CartpoleBalanc")
