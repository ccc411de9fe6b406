"""Agents that see depth, or several cameras."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_gym.cli.train import parse
from pixelbrax_jax import PixelEnv, VectorPixelEnv, load_policy
from pixelbrax_jax.agents import DCPG, PPG, PPO, DrQv2, PPOConfig
from pixelbrax_jax.agents.networks.encoders import scaled
from pixelbrax_jax.agents.rollout import collect, observations
from pixelbrax_jax.agents.runner.settings import RunConfig
from pixelbrax_jax.agents.runner.train import train
from pixelbrax_jax.agents.runner.trained import save_policy
from pixelbrax_jax.config import EnvConfig
from tests.agents.small import EPISODE_LENGTH, OPTIONS, PARAMS, settings_of
from tests.envs.toy import Ball

TWO = PARAMS.replace(rig=(PARAMS.rig, PARAMS.rig.replace(eye=np.float32([0.5, -3, 2]))))
CASES = {
    "depth": ({"obs_mode": "depth"}, PARAMS, (18, 18, 2)),
    "two cameras": ({"camera": ("default", "top")}, TWO, (18, 18, 12)),
    "depth of two": ({"obs_mode": "depth", "camera": ("default", "top")}, TWO, (18, 18, 4)),
}


def agent(kind, options):
    """An algorithm with its settings, and environments of the ball that fit."""
    env = EnvConfig(**OPTIONS, **options, episode_length=EPISODE_LENGTH)
    config = kind.config_class(**settings_of(kind) | {"env": env, "total_steps": 1000})
    mode = env.obs_mode
    ball = PixelEnv(Ball(), obs_mode=mode, num_cameras=env.num_cameras, **OPTIONS)
    return kind(config, VectorPixelEnv(ball, config.num_envs))


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n == "depth of two" else pytest.mark.slow) for n in CASES],
)
def test_an_iteration_changes_every_network(name, tmp_path):
    options, params, shape = CASES[name]
    ppo = agent(PPO, options)
    assert ppo.envs.env.obs_spec.shape == shape
    state = ppo.init(jax.random.key(0), params)
    after, metrics = jax.jit(ppo.iterate)(state, params)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(metrics))
    for one, other in zip(*map(jax.tree.leaves, (state.networks, after.networks)), strict=True):
        assert (one != other).any()
    policy = load_policy(save_policy(ppo, after.networks, tmp_path / "policy.jax"))
    obs = ppo.envs.obs(after.env_state)
    np.testing.assert_allclose(policy(obs), ppo.act(after.networks, obs), atol=1e-5)
    with pytest.raises(ValueError, match="the policy takes"):
        policy(obs.astype(jnp.float16))


@pytest.mark.parametrize("name", CASES)
def test_rollouts_rebuild_what_was_observed(name):
    options, params, _ = CASES[name]
    envs = agent(PPO, options).envs

    def choose(pixels, state, key):
        return jax.random.uniform(key, (envs.num_envs, 1), minval=-1.0), pixels

    start, _ = envs.reset(jax.random.key(0), params)
    _, rollout = jax.jit(lambda s, k: collect(envs, s, params, choose, k, 8))(
        start, jax.random.key(1)
    )
    times = jnp.broadcast_to(jnp.arange(8)[:, None], (8, envs.num_envs))
    rebuilt = observations(rollout.frames, times)
    rebuilt = rebuilt.reshape(envs.num_envs, 8, *rollout.choice.shape[2:])
    np.testing.assert_array_equal(jnp.moveaxis(rebuilt, 0, 1), rollout.choice)


@pytest.mark.parametrize("kind", [PPG, DCPG])
def test_phasic_agents_learn_from_depth_in_their_auxiliary_phase(kind):
    options, params, _ = CASES["depth of two"]
    phasic = agent(kind, options)
    state = phasic.init(jax.random.key(0), params)
    for _ in range(phasic.auxiliary_every):
        state, _ = jax.eval_shape(phasic.iterate, state, params)
    _, metrics = jax.eval_shape(phasic.auxiliary, state)
    assert metrics


def test_a_replay_holds_depths():
    drq = agent(DrQv2, {"obs_mode": "depth"})
    state = drq.init(jax.random.key(0), PARAMS)
    assert state.replay.frame.shape[2:] == (18, 18, 1)
    assert state.replay.frame.dtype == jnp.float32
    after, _ = jax.jit(drq.iterate)(state, PARAMS)
    assert (after.replay.frame[:, :8] > 0).all()
    assert drq.config.frame_bytes == 18 * 18 * 4


def test_depth_is_scaled_to_a_fraction():
    depth = jnp.array([0.0, 1.0, 3.0, 100.0])
    np.testing.assert_allclose(scaled(depth), [1.0, 0.5, 0.25, 1 / 101], rtol=1e-6)


def test_settings_say_what_they_need():
    with pytest.raises(ValueError, match="must be 'pixels' or 'depth', got 'pixels\\+depth'"):
        PPOConfig(env=EnvConfig(obs_mode="pixels+depth"))
    with pytest.raises(ValueError, match="an agent's cameras are channels of one image: leave"):
        PPOConfig(env=EnvConfig(camera=("a", "b"), camera_sizes={"a": (36, 36), "b": (24, 24)}))
    with pytest.raises(TypeError, match="camera of training settings must be a name, got"):
        PPOConfig(env=EnvConfig(camera=("front", PARAMS.rig)))
    ppo = agent(PPO, {})
    with pytest.raises(ValueError, match="number of cameras is 2 in the settings, but 1 in"):
        PPO(ppo.config.replace(camera=("default", "top")), ppo.envs)
    with pytest.raises(ValueError, match="obs_mode of the environments must be 'depth' with"):
        PPO(ppo.config.replace(obs_mode="depth"), ppo.envs)


@pytest.mark.slow
def test_a_run_is_stored_and_continues(tmp_path):
    options = {"obs_mode": "depth", "camera": ("default", "top"), "episode_length": 8}
    env = EnvConfig(task="inverted_pendulum", **OPTIONS, **options)
    config = PPOConfig(**settings_of(PPO) | {"env": env, "total_steps": 64, "anneal": False})
    run = RunConfig(output_dir=str(tmp_path), num_evals=1, eval_episodes=2)
    train(config, run)
    train(config.replace(total_steps=96), replace(run, resume="latest"))
    assert load_policy(tmp_path / "policy.jax").shape == (18, 18, 4)


def test_the_command_takes_several_cameras():
    line = "--preset ci --obs-mode depth --camera front top"
    _, config, _ = parse("ppo", line.split())
    assert config.env.camera == ("front", "top")
    assert config.env.obs_mode == "depth"
    assert parse("ppo", ["--camera", "top"])[1].env.camera == "top"
