"""Brax's trainers on our pixel environment, seen through `BraxEnv`."""

from __future__ import annotations

from functools import partial

import jax
import numpy as np
import pytest

import pixelbrax_jax as pb
from tests.envs.toy import Ball, limited


def make(**options):
    env = pb.PixelEnv(Ball(), height=16, width=16, frame_stack=1, **options)
    return pb.BraxEnv(env, limited(6))


def finite_and_changed(before, after):
    before, after = jax.tree.leaves(before), jax.tree.leaves(after)
    assert all(np.isfinite(x).all() for x in after)
    return any((x != y).any() for x, y in zip(before, after, strict=True))


@pytest.mark.parametrize("obs_mode", ["pixels", "both"])
def test_ppo_learns_from_pictures(obs_mode):
    # Brax warns when it is imported before PixelBrax, which knows the warning.
    from brax.training.agents.ppo import networks_vision
    from brax.training.agents.ppo import train as ppo

    told, params = [], []
    extra = {"policy_obs_key": "state", "value_obs_key": "state"} if obs_mode == "both" else {}
    make_policy, trained, _ = ppo.train(
        make(obs_mode=obs_mode),
        num_timesteps=320,
        episode_length=6,
        num_envs=4,
        batch_size=4,
        num_minibatches=2,
        unroll_length=4,
        num_updates_per_batch=1,
        num_evals=0,
        vision=True,
        wrap_env_fn=pb.wrap_fresh_episodes,
        log_training_metrics=True,
        network_factory=partial(
            networks_vision.make_ppo_networks_vision,
            policy_hidden_layer_sizes=(8,),
            value_hidden_layer_sizes=(8,),
            cnn_output_channels=(4,),
            cnn_kernel_size=(4,),
            cnn_stride=(2,),
            cnn_global_pool="none",
            **extra,
        ),
        progress_fn=lambda steps, metrics: told.append(metrics),
        policy_params_fn=lambda steps, make_policy, now: params.append(now),
    )
    assert finite_and_changed(params[0][1], trained[1])
    # Every episode is as long as the limit, unless it began just now.
    assert 0 < told[-1]["episode/length"] <= 6
    assert told[-1]["episode/non_finite"] == 0

    state = jax.jit(make(obs_mode=obs_mode).reset)(jax.random.PRNGKey(0))
    action, _ = make_policy(trained, deterministic=True)(state.obs, jax.random.PRNGKey(1))
    assert action.shape == (1,)
    assert np.isfinite(action).all()


def test_sac_learns_from_states():
    from brax.training.agents.sac import networks
    from brax.training.agents.sac import train as sac

    _, trained, metrics = sac.train(
        make(obs_mode="state"),
        num_timesteps=96,
        episode_length=6,
        num_envs=4,
        batch_size=8,
        min_replay_size=16,
        max_replay_size=64,
        grad_updates_per_step=1,
        num_evals=2,
        num_eval_envs=4,
        network_factory=partial(networks.make_sac_networks, hidden_layer_sizes=(8,)),
    )
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(trained))
    # The evaluation's episodes are whole.
    assert metrics["eval/avg_episode_length"] == 6
    # The ball stays within -0.5 - 6 * 0.1 and 0.6.
    assert -6 * 1.1 < metrics["eval/episode_reward"] < 6 * 0.6
