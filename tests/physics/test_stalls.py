"""MuJoCo in compiled programs neither stalls on loaded cores nor holds up Ctrl-C."""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import subprocess
import sys
import threading
import time

import pytest

pytest.importorskip("dm_control", reason="the tasks' models come with pixelbrax[dmc]")

STEPS = 10_000
PATIENCE = 60.0
"""Seconds without a line after which a program counts as stalled; lines come every second or so."""

LOADED = "while True: sum(range(1000))"

IN_A_SCAN = """
import sys, jax, jax.numpy as jnp, pixelbrax_jax as pb
env, params = pb.make("dmc_pendulum_swingup", engine="mujoco", obs_mode="state")
envs = pb.VectorPixelEnv(env, int(sys.argv[1]))
state, _ = envs.reset(jax.random.key(0), params)
actions = jnp.full((envs.num_envs, 1), 0.5)

@jax.jit
def play(state):
    step = lambda state, _: (envs.step(state, actions, params)[0], None)
    return jax.lax.scan(step, state, length=500)[0]

for _ in range(int(sys.argv[2]) // 500):
    state = jax.block_until_ready(play(state))
    print("going on", flush=True)
"""

IN_A_LOOP = """
import sys, torch, gymnasium, pixelbrax_gym
envs = gymnasium.make_vec("PixelBrax/DMC-PendulumSwingup-v0", num_envs=int(sys.argv[1]),
                          engine="mujoco", obs_mode="state", output="torch")
envs.reset(seed=0)
actions = torch.full((envs.num_envs, 1), 0.5)
for i in range(int(sys.argv[2])):
    obs, *_ = envs.step(actions)
    obs.sum().item()
    if i % 500 == 499:
        print("going on", flush=True)
"""


@contextlib.contextmanager
def running(program, *arguments):
    command = [sys.executable, "-c", program, *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.fixture
def loaded_cores():
    with contextlib.ExitStack() as stack:
        for _ in range(os.cpu_count() or 1):
            stack.enter_context(running(LOADED))
        yield


def lines(process):
    """Lines of a program, until it ends; fails if none comes for ``PATIENCE``."""
    found: queue.SimpleQueue[str | None] = queue.SimpleQueue()

    def read():
        for line in process.stdout:
            found.put(line)
        found.put(None)

    threading.Thread(target=read, daemon=True).start()
    while True:
        try:
            line = found.get(timeout=PATIENCE)
        except queue.Empty:
            process.kill()
            pytest.fail(f"nothing moved for {PATIENCE} s")
        if line is None:
            return
        yield line


@pytest.mark.slow
@pytest.mark.usefixtures("loaded_cores")
@pytest.mark.parametrize("num_envs", [1, 16, 256])
@pytest.mark.parametrize("program", [IN_A_SCAN, IN_A_LOOP], ids=["scan", "loop"])
def test_ten_thousand_steps_on_loaded_cores(program, num_envs):
    with running(program, num_envs, STEPS) as process:
        assert len(list(lines(process))) == STEPS // 500
        assert process.wait(PATIENCE) == 0


@pytest.mark.slow
@pytest.mark.parametrize("num_envs", [1, 256])
@pytest.mark.parametrize("program", [IN_A_SCAN, IN_A_LOOP], ids=["scan", "loop"])
def test_ctrl_c_ends_a_program_that_would_run_for_minutes(program, num_envs):
    with running(program, num_envs, 100 * STEPS) as process:
        next(lines(process))
        process.send_signal(signal.SIGINT)
        before = time.monotonic()
        assert process.wait(PATIENCE) != 0
        assert time.monotonic() - before < 10.0
