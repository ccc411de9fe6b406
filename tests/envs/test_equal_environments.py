"""Environments made of equal options share compiled programs; parameters compile nothing anew."""

from __future__ import annotations

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pixelbrax_gym
import pixelbrax_jax as pb
from pixelbrax_jax.envs.sharded import make_env_mesh
from tests.compilations import counted
from tests.envs.toy import PARAMS, Ball

TASK = "ball_of_equals"
SIZE = {"height": 12, "width": 12, "frame_stack": 1}
ACTION = jnp.zeros(1)


@pytest.fixture(scope="session", autouse=True)
def gymnasium_id():
    pb.register(TASK, Ball, camera=PARAMS.rig)
    return pixelbrax_gym.register(TASK)


def use(env: pb.PixelEnv, params: pb.EnvParams, seed: int = 0) -> None:
    state, _ = env.reset(jax.random.key(seed), params)
    env.step(state, ACTION, params)
    vector = pb.VectorPixelEnv(env, 2)
    state, _ = vector.reset(jax.random.key(seed), params)
    vector.step(state, jnp.zeros((2, 1)), params)


def test_nothing_is_compiled_twice():
    use(*pb.make(TASK, **SIZE))
    red = {"geoms": np.float32([[1.0, 0.0, 0.0]])}
    rig = pb.make_rig((0.0, -3.0, 0.5), (0.0, 0.0, 0.0), 40.0)
    changes = {
        "the same again": {},
        "time limit": {"episode_length": 7},
        "camera by name": {"camera": "top"},
        "camera pose": {"camera": rig},
        "light": {"look": pb.make_look().replace(light=np.float32([0.0, 0.0, 1.0]))},
        "numpy integers": {"height": np.int64(12)},
        "an option at its default": {"distractors": None, "action_repeat": 1},
    }
    for name, options in changes.items():
        env, params = pb.make(TASK, **SIZE | options)
        with counted() as events:
            use(env, params, seed=3)
        assert not events, name
    env, params = pb.make(TASK, **SIZE)
    rgb = jnp.broadcast_to(red["geoms"], params.geoms.rgb.shape)
    key = jax.random.key(1)
    repainted = params.replace(geoms=params.geoms.replace(rgb=rgb))
    with counted() as events:
        env.reset(key, repainted)
    assert not events


def test_the_counter_sees_a_compilation():
    with counted() as events:
        jax.jit(lambda x: x + 1)(1.0)
    assert any("backend_compile" in event for event in events)


def test_adapters_share_programs(gymnasium_id):
    def play(**options):
        env = gymnasium.make_vec(gymnasium_id, num_envs=2, **SIZE, **options)
        env.reset(seed=0)
        env.step(np.zeros((2, 1), np.float32))

    play()
    with counted() as events:
        play()
        play(episode_length=9, camera="top", max_episode_steps=3)
    assert not events


def test_batches_are_equal_by_value():
    first, second = pb.make(TASK, **SIZE)[0], pb.make(TASK, **SIZE)[0]
    assert pb.VectorPixelEnv(first, 2) == pb.VectorPixelEnv(second, 2)
    assert pb.VectorPixelEnv(first, 2) != pb.VectorPixelEnv(first, 3)
    assert pb.VectorPixelEnv(first, 2) != pb.VectorPixelEnv(first, 2, "same_step")
    mesh = make_env_mesh(1)
    assert pb.ShardedVectorEnv(first, 2, mesh) == pb.ShardedVectorEnv(second, 2, make_env_mesh(1))


def test_physics_that_are_loaded_again_are_equal():
    from pixelbrax_jax.physics.brax import loading

    first = pb.make("inverted_pendulum", **SIZE)[0]
    loading._load.cache_clear()
    second = pb.make("inverted_pendulum", **SIZE)[0]
    assert first.physics is not second.physics
    assert first == second
