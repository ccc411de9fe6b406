"""Long runs: no recompilation, no leak, the same bits in two processes."""

from __future__ import annotations

import gc
import hashlib
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
import torch

from tests.compilations import counted

PAGES_PER_MIB = 256


def resident_mib() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) / PAGES_PER_MIB


@pytest.mark.parametrize("mode", ["next_step", "same_step", "disabled"])
def test_nothing_is_compiled_twice(make_vector, mode):
    env = make_vector(autoreset_mode=mode)

    def play(num_steps):
        env.reset(seed=num_steps)
        for _ in range(num_steps):
            done = np.asarray(env._stateful._snapshot.ended)
            if mode == "disabled" and done.any():
                env.reset(options={"reset_mask": done})
            env.step(env.action_space.sample())

    play(10)
    with counted() as events:
        play(100)
    assert not events


def test_equal_options_share_programs(make_vector):
    one, other = make_vector(), make_vector(episode_length=3)
    assert one._stateful._programs == other._stateful._programs
    assert one._stateful._programs != make_vector(2)._stateful._programs


@pytest.fixture
def make_stepper(make_vector, make_torchrl, make_sb3):
    """A function that steps two environments once, through the adapter of that name."""
    action = np.full((2, 1), -0.1, np.float32)

    def make(adapter):
        options = {"num_envs": 2, "height": 8, "width": 8, "episode_length": 6}
        if adapter == "torchrl":
            env = make_torchrl(**options)
            carry = [env.reset()]

            def step():
                td = carry[0].set("action", torch.from_numpy(action))
                carry[0] = env.step_and_maybe_reset(td)[1]

            return step
        if adapter == "sb3":
            env = make_sb3(**options)
        else:
            env = make_vector(**options, output=adapter, autoreset_mode="same_step")
        env.reset()
        return lambda: env.step(action)

    return make


def run(step, num_steps: int) -> tuple[int, float]:
    for _ in range(num_steps):
        step()
    gc.collect()
    return len(jax.live_arrays()), resident_mib()


@pytest.mark.parametrize("adapter", ["numpy", "torch", "torchrl", "sb3"])
@pytest.mark.parametrize("num_steps", [1_000, pytest.param(50_000, marks=pytest.mark.slow)])
def test_nothing_leaks(make_stepper, num_steps, adapter):
    step = make_stepper(adapter)
    arrays, memory = run(step, 500)
    arrays_later, memory_later = run(step, num_steps)
    # TorchRL's adapter holds a few more where a step has ended an episode.
    assert abs(arrays_later - arrays) < 10
    # A single leaked observation a step would be 0.4 kB, its Python object about as much.
    assert memory_later - memory < 4 + num_steps * 0.2e-3


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
