"""Environment i is the same whatever the number of environments."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import pixelbrax_jax
from pixelbrax_jax import VectorPixelEnv

NUM_STEPS = 40  # a random pole falls within them


def rollout(num_envs: int):
    env, params = pixelbrax_jax.make(
        "inverted_pendulum", height=24, width=24, frame_stack=2, obs_mode="both"
    )
    venv = VectorPixelEnv(env, num_envs)
    state, timestep = venv.reset(jax.random.key(3), params)
    steps = [timestep]
    for t in range(NUM_STEPS):
        key = jax.random.fold_in(jax.random.key(4), t)
        # Drawn per environment, so that environment i acts alike in every batch.
        actions = jax.vmap(
            lambda i, key=key: jax.random.uniform(
                jax.random.fold_in(key, i), (1,), minval=-1.0, maxval=1.0
            )
        )(np.arange(num_envs))
        state, timestep = venv.step(state, actions, params)
        steps.append(timestep)
    return state, jax.tree.map(lambda *leaves: np.stack(leaves), *steps)


@pytest.fixture(scope="module")
def largest():
    return rollout(8)


@pytest.mark.slow
@pytest.mark.parametrize("num_envs", [1, 4])
def test_environment_does_not_depend_on_the_batch(largest, num_envs):
    large_state, large = largest
    small_state, small = rollout(num_envs)
    rows = slice(0, num_envs)
    # What is sampled and counted is equal to the bit ...
    for name in ("terminated", "truncated"):
        np.testing.assert_array_equal(getattr(small, name), getattr(large, name)[:, rows])
    np.testing.assert_array_equal(
        small.info["episode_length"], large.info["episode_length"][:, rows]
    )
    np.testing.assert_array_equal(small_state.sim.episode, large_state.sim.episode[rows])
    np.testing.assert_array_equal(
        jax.random.key_data(small_state.key), jax.random.key_data(large_state.key[rows])
    )
    assert (large_state.sim.episode[rows] > 0).any()
    # ... and so are pixels, but for a level on few of them; physics agrees to rounding, which
    # another batch size may do in another order.
    np.testing.assert_allclose(
        small.obs["state"], large.obs["state"][:, rows], rtol=1e-4, atol=1e-5
    )
    np.testing.assert_array_equal(small.obs["pixels"][0], large.obs["pixels"][0, rows])
    difference = np.abs(small.obs["pixels"].astype(int) - large.obs["pixels"][:, rows].astype(int))
    assert np.mean(difference > 1) < 1e-3
