"""Frames cross on an accelerator without a copy; run with `pytest -m gpu`."""

from __future__ import annotations

import gymnasium
import jax
import numpy as np
import pytest
import torch

import pixelbrax_gym
from pixelbrax_gym import doctor
from pixelbrax_gym.interop import dlpack

pytestmark = pytest.mark.gpu

ID = "PixelBrax/InvertedPendulum-v0"
SIZE = {"num_envs": 8, "height": 32, "width": 32}


@pytest.fixture(autouse=True)
def _needs_a_gpu():
    if jax.devices()[0].platform != "gpu" or not torch.cuda.is_available():
        pytest.fail("these tests need a GPU that both JAX and torch see")


def test_a_frame_is_the_buffer_that_jax_computed():
    envs = gymnasium.make_vec(ID, output="torch", **SIZE)
    envs.reset(seed=0)
    seen = []
    step = envs._stateful.step
    envs._stateful.step = lambda action: seen.append(step(action)) or seen[-1]
    obs, reward, *_ = envs.step(torch.zeros(8, 1, device="cuda"))
    assert obs.is_cuda
    assert reward.is_cuda
    assert obs.data_ptr() == seen[0]["obs"].unsafe_buffer_pointer()
    envs.close()


def test_torch_waits_for_the_frame():
    """Work on torch's stream sees the finished frame, though nobody waited on the host."""
    envs = gymnasium.make_vec(ID, output="torch", **SIZE)
    arrays = gymnasium.make_vec(ID, output="jax", **SIZE)
    envs.reset(seed=0), arrays.reset(seed=0)
    for _ in range(20):
        action = torch.rand(8, 1, device="cuda") * 2 - 1
        total = envs.step(action)[0].sum(dtype=torch.int64)
        expected = np.asarray(arrays.step(action)[0]).sum(dtype=np.int64)
        assert total.item() == expected
        action.fill_(9.0)  # may be refilled at once


def test_torch_on_a_stream_of_its_own():
    envs = gymnasium.make_vec(ID, output="torch", **SIZE)
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        obs, _ = envs.reset(seed=0)
        total = obs.sum(dtype=torch.int64)
    stream.synchronize()
    expected = gymnasium.make_vec(ID, **SIZE).reset(seed=0)[0].sum(dtype=np.int64)
    assert total.item() == expected


def test_actions_on_the_host_are_refused():
    envs = gymnasium.make_vec(ID, output="torch", **SIZE)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match="on device cpu, the environment on cuda"):
        envs.step(torch.zeros(8, 1))


def test_kept_frames_stay_as_they_were():
    envs = gymnasium.make_vec(ID, output="torch", **SIZE)
    envs.reset(seed=0)
    kept = [envs.step(torch.rand(8, 1, device="cuda"))[0] for _ in range(50)]
    copies = [frame.clone() for frame in kept]
    for _ in range(50):
        envs.step(torch.rand(8, 1, device="cuda"))
    envs.close()
    assert all(torch.equal(a, b) for a, b in zip(kept, copies, strict=True))


def test_torchrl():
    pytest.importorskip("torchrl")
    env = pixelbrax_gym.PixelBraxTorchRLEnv("inverted_pendulum", 8, height=32, width=32)
    env.set_seed(0)
    rollout = env.rollout(10, break_when_any_done=False)
    assert rollout["pixels"].is_cuda
    host = pixelbrax_gym.PixelBraxTorchRLEnv(
        "inverted_pendulum", 8, height=32, width=32, device="cpu"
    )
    host.set_seed(0)
    assert host.rollout(2)["pixels"].device.type == "cpu"


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


def test_the_doctor_is_content():
    assert not [f for f in doctor.diagnose(doctor.inspect()) if f.level == "trouble"]
    assert dlpack.default_torch_device().type == "cuda"
