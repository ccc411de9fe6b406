"""No copy from JAX to torch or NumPy, and no way back into the environment."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from pixelbrax_gym.interop import dlpack
from pixelbrax_gym.resets import as_mask

ACTIONS = np.array([[-0.2], [0.9], [1.0]], np.float32)


def test_to_torch_shares_memory():
    tree = {"a": jnp.arange(6, dtype=jnp.uint8).reshape(2, 3), "b": (jnp.ones(2, bool),)}
    tensors = dlpack.to_torch(tree)
    assert tensors["a"].data_ptr() == tree["a"].unsafe_buffer_pointer()
    assert tensors["a"].dtype == torch.uint8
    assert tensors["b"][0].data_ptr() == tree["b"][0].unsafe_buffer_pointer()
    assert tensors["b"][0].dtype == torch.bool


def pointers(tree):
    return {leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(tree)}


@pytest.mark.parametrize("mode", ["next_step", "same_step", "disabled"])
def test_nothing_exported_is_part_of_the_state(make_vector, mode):
    env = make_vector(obs_mode="both", autoreset_mode=mode, output="jax")
    stateful = env._stateful
    for outputs in (
        stateful.reset(0, np.random.default_rng(0)),
        stateful.step(ACTIONS),
        stateful.reset(None, np.random.default_rng(0), np.array([True, False, False])),
    ):
        assert not pointers(outputs) & pointers(stateful._snapshot.packed)


def test_actions_are_copied():
    device = jax.devices("cpu")[0]
    actions = torch.full((2, 3), 0.5)
    converted = dlpack.actions_to_jax(actions, device)
    actions.fill_(-1.0)
    np.testing.assert_array_equal(converted, np.full((2, 3), 0.5, np.float32))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_actions_are_rounded_to_float32(dtype):
    # Every second number of a tensor with a gradient.
    actions = torch.full((4,), 0.5, dtype=dtype, requires_grad=True)[::2]
    converted = dlpack.actions_to_jax(actions, jax.devices("cpu")[0])
    assert converted.dtype == np.float32
    np.testing.assert_array_equal(converted, [0.5, 0.5])


def test_masks_are_copied():
    array, tensor = np.ones(4, bool), torch.ones(4, dtype=bool)
    read = [as_mask("mask", given, (4,)) for given in (array, tensor)]
    array[:], tensor[:] = False, False
    assert all(mask.all() for mask in read)


def test_refilling_the_action_buffer_at_once_is_harmless(make_vector):
    env, expected = make_vector(output="jax", obs_mode="state"), make_vector(obs_mode="state")
    buffer = np.zeros((3, 1), np.float32)
    env.reset(seed=0), expected.reset(seed=0)
    for value in np.linspace(-0.5, 0.5, 50, dtype=np.float32):
        buffer[:] = value
        obs = env.step(buffer)[0]
        buffer[:] = 77.0
        wanted = expected.step(np.full((3, 1), value))[0]
        np.testing.assert_array_equal(obs, wanted)


def test_devices_must_agree():
    with pytest.raises(ValueError, match=r"on device meta, the environment on cpu:0"):
        dlpack.actions_to_jax(torch.zeros(1, device="meta"), jax.devices("cpu")[0])
