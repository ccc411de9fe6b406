"""Long runs: no leak, the same bits in two processes."""

from __future__ import annotations

import gc
import hashlib
import subprocess
import sys

import jax
import pytest

from tests.conftest import memory_of_this_process
from tests.gym.adapters import ADAPTERS


def resident_mib() -> float:
    """0 where the system does not tell."""
    return memory_of_this_process()[1] / 2**20


def test_equal_options_share_programs(make_vector):
    one, other = make_vector(), make_vector(episode_length=3)
    assert one._stateful._programs == other._stateful._programs
    assert one._stateful._programs != make_vector(2)._stateful._programs


@pytest.fixture
def frozen():
    """Collections look at the test's own objects, not at the millions of earlier tests."""
    gc.freeze()
    yield
    gc.unfreeze()


def run(adapter, num_calls: int) -> tuple[int, float]:
    for _ in range(num_calls):
        adapter.call()
    gc.collect()
    return len(jax.live_arrays()), resident_mib()


@pytest.mark.parametrize("name", ["numpy", "torch", "torchrl", "sb3"])
@pytest.mark.parametrize("num_calls", [1_000, pytest.param(50_000, marks=pytest.mark.slow)])
def test_nothing_leaks(num_calls, name, frozen):
    adapter = ADAPTERS[name](episode_length=6)
    adapter.reset()
    arrays, memory = run(adapter, 500)
    window, grown = num_calls // 2, []
    for _ in range(3):
        arrays_later, memory_later = run(adapter, window)
        # TorchRL's adapter holds a few more where a step has ended an episode.
        assert abs(arrays_later - arrays) < 10
        grown.append(memory_later - memory)
        memory = memory_later
    # A single leaked observation a step would be 2.6 kB. Other threads of the process may take
    # memory meanwhile, but not in most windows.
    assert sorted(grown)[1] < 0.5 + window * 0.2e-3


DIGEST = """
import hashlib, gymnasium, numpy as np, pixelbrax_gym
env = gymnasium.make_vec(
    "PixelBrax/InvertedPendulum-v0", num_envs=2, height=16, width=16, obs_mode="both",
    max_episode_steps=20,
)
digest = hashlib.sha256()
def add(*arrays):
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
obs, _ = env.reset(seed=3)
add(obs["pixels"], obs["state"])
rng = np.random.default_rng(0)
for _ in range(64):
    obs, *rest, infos = env.step(rng.uniform(-1, 1, (2, 1)).astype(np.float32))
    add(obs["pixels"], obs["state"], *rest, infos["episode_return"])
print(digest.hexdigest())
"""


@pytest.mark.slow
def test_two_processes_agree_bitwise():
    command = [sys.executable, "-c", DIGEST]
    runs = [subprocess.run(command, capture_output=True, check=True, text=True) for _ in "ab"]
    assert len(runs[0].stdout.strip()) == len(hashlib.sha256().hexdigest())
    assert runs[0].stdout == runs[1].stdout
