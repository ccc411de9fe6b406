"""Frames and actions cross on an accelerator; run with `make test-gpu`."""

from __future__ import annotations

import gc
import os

import gymnasium
import jax
import numpy as np
import pytest
import torch

import pixelbrax_gym
from pixelbrax_gym import doctor
from pixelbrax_gym.interop import dlpack
from tests.gpu.processes import told

pytestmark = pytest.mark.gpu

ID = "PixelBrax/InvertedPendulum-v0"
SIZE = {"num_envs": 8, "height": 32, "width": 32}


def test_a_frame_is_the_buffer_that_jax_computed(device):
    envs = gymnasium.make_vec(ID, output="torch", **SIZE)
    envs.reset(seed=0)
    seen = []
    step = envs._stateful.step
    envs._stateful.step = lambda action: seen.append(step(action)) or seen[-1]
    obs, reward, *_ = envs.step(torch.zeros(8, 1, device=device))
    assert obs.device.type == reward.device.type == device
    assert obs.data_ptr() == seen[0]["obs"].unsafe_buffer_pointer()
    envs.close()


def test_a_tensor_comes_back_as_the_same_buffer(device):
    array = jax.numpy.arange(64.0).reshape(8, 8)
    tensor = dlpack.to_torch(array)
    back = jax.dlpack.from_dlpack(tensor)
    assert array.unsafe_buffer_pointer() == tensor.data_ptr() == back.unsafe_buffer_pointer()


def test_an_action_is_a_copy(device):
    """JAX may read an action after its owner has filled in the next one."""
    tensor = torch.full((8, 1), 0.5, device=device)
    action = dlpack.actions_to_jax(tensor, jax.devices()[0])
    tensor.fill_(9.0)
    np.testing.assert_array_equal(np.asarray(action), 0.5)
    if device == "cuda":
        assert action.unsafe_buffer_pointer() != tensor.data_ptr()


def test_torch_waits_for_the_frame(device):
    """Work on torch's stream sees the finished frame, though nobody waited on the host."""
    envs = gymnasium.make_vec(ID, output="torch", **SIZE)
    arrays = gymnasium.make_vec(ID, output="jax", **SIZE)
    envs.reset(seed=0), arrays.reset(seed=0)
    for _ in range(20):
        action = torch.rand(8, 1, device=device) * 2 - 1
        total = envs.step(action)[0].sum(dtype=torch.int64)
        expected = np.asarray(arrays.step(jax.numpy.asarray(action.cpu().numpy()))[0])
        assert total.item() == expected.sum(dtype=np.int64)
        action.fill_(9.0)  # may be refilled at once


@pytest.mark.cuda_only
def test_torch_on_a_stream_of_its_own():
    envs = gymnasium.make_vec(ID, output="torch", **SIZE)
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        obs, _ = envs.reset(seed=0)
        total = obs.sum(dtype=torch.int64)
        for _ in range(20):
            obs = envs.step(torch.zeros(8, 1, device="cuda"))[0]
            total = total + obs.sum(dtype=torch.int64)
    stream.synchronize()
    others = gymnasium.make_vec(ID, **SIZE)
    expected = others.reset(seed=0)[0].sum(dtype=np.int64)
    for _ in range(20):
        expected += others.step(np.zeros((8, 1), np.float32))[0].sum(dtype=np.int64)
    assert total.item() == expected


@pytest.mark.cuda_only
def test_actions_on_the_host_are_refused():
    envs = gymnasium.make_vec(ID, output="torch", **SIZE)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match="on device cpu, the environment on cuda"):
        envs.step(torch.zeros(8, 1))


def test_kept_frames_stay_as_they_were(device):
    envs = gymnasium.make_vec(ID, output="torch", **SIZE)
    envs.reset(seed=0)
    kept = [envs.step(torch.rand(8, 1, device=device))[0] for _ in range(50)]
    copies = [frame.clone() for frame in kept]
    for _ in range(50):
        envs.step(torch.rand(8, 1, device=device))
    envs.close()
    del envs
    gc.collect()
    assert all(torch.equal(a, b) for a, b in zip(kept, copies, strict=True))


def test_writing_to_a_frame_changes_no_later_one(device):
    ours, others = (gymnasium.make_vec(ID, output="torch", **SIZE) for _ in range(2))
    action = torch.zeros(8, 1, device=device)
    ours.reset(seed=0)[0].zero_()
    others.reset(seed=0)
    for _ in range(5):
        obs, untouched = ours.step(action)[0], others.step(action)[0]
        assert torch.equal(obs, untouched)
        obs.fill_(77)


def test_torchrl(device):
    pytest.importorskip("torchrl")
    env = pixelbrax_gym.TorchRLEnv("inverted_pendulum", 8, height=32, width=32)
    env.set_seed(0)
    rollout = env.rollout(10, break_when_any_done=False)
    assert rollout["pixels"].device.type == device
    host = pixelbrax_gym.TorchRLEnv("inverted_pendulum", 8, height=32, width=32, device="cpu")
    host.set_seed(0)
    assert host.rollout(2)["pixels"].device.type == "cpu"


@pytest.mark.cuda_only
def test_memory_stays_flat():
    envs = gymnasium.make_vec(ID, output="torch", **SIZE)
    envs.reset(seed=0)
    action = torch.zeros(8, 1, device="cuda")

    def in_use():
        torch.cuda.synchronize()
        return jax.devices()[0].memory_stats()["bytes_in_use"], len(jax.live_arrays())

    for _ in range(100):
        envs.step(action)
    before = in_use()
    for _ in range(1000):
        envs.step(action)
    assert in_use() == before


SIDE_BY_SIDE = """
import gymnasium, torch
import pixelbrax_gym
envs = gymnasium.make_vec("PixelBrax/InvertedPendulum-v0", num_envs=8, height=32, width=32,
                          output="torch")
obs, _ = envs.reset(seed=0)
device = obs.device
size = torch.cuda.mem_get_info()[0] // 2 if device.type == "cuda" else 2**20
theirs = torch.zeros(size, dtype=torch.uint8, device=device)
for _ in range(20):
    obs = envs.step(torch.zeros(8, 1, device=device))[0]
    theirs[:1000] += obs.flatten()[:1000]
print(int(theirs[:1000].sum(dtype=torch.int64)))
"""


@pytest.mark.parametrize(
    "setting",
    [
        {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"},
        {"XLA_CLIENT_MEM_FRACTION": "0.3"},
        {},
    ],
    ids=["as needed", "a third", "default"],
)
def test_torch_has_memory_beside_jax(setting):
    """Half of what JAX leaves is torch's to take, whatever JAX takes at its start."""
    assert int(told(SIDE_BY_SIDE, os.environ | setting)) > 0


@pytest.mark.cuda_only
def test_the_doctor_is_content():
    assert not [f for f in doctor.diagnose(doctor.inspect()) if f.level == "problem"]
    assert dlpack.default_torch_device().type == "cuda"
