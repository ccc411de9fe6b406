"""An exception that arrives at any time leaves the state before a step or the one after."""

from __future__ import annotations

import random
import signal
import sys
import time

import gymnasium
import numpy as np
import pytest
import torch

import pixelbrax_gym
from pixelbrax_jax import compilation
from tests.gym.conftest import ID, SIZE, TASK

# JAX calls Python from within, e.g. in callbacks of weak references: what is raised there is lost.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

SIGNALS = 60
"""Of each adapter."""
OPTIONS = SIZE | {"episode_length": 7}
PACKAGE = pixelbrax_gym.__path__[0]


class InterruptedStepError(KeyboardInterrupt):
    """Raised by the handler of a timer's signal."""


def single():
    env = gymnasium.make(ID, **OPTIONS)

    def step():
        if env.unwrapped._stateful._snapshot.done:
            env.reset()
        else:
            env.step(np.zeros(1, np.float32))

    return env.unwrapped, lambda: env.reset(seed=0), step


def vector(output):
    def make():
        env = gymnasium.make_vec(ID, num_envs=3, output=output, **OPTIONS)
        return env, lambda: env.reset(seed=0), lambda: env.step(np.zeros((3, 1), np.float32))

    return make


def sb3():
    env = pixelbrax_gym.SB3VecEnv(TASK, 3, **OPTIONS)

    def reset():
        env.seed(0)
        env.reset()

    return env, reset, lambda: env.step(np.zeros((3, 1), np.float32))


def torchrl():
    env = pixelbrax_gym.TorchRLEnv(TASK, 3, **OPTIONS)
    zeros = torch.zeros(3, 1)
    latest = [None]

    def reset():
        env.set_seed(0)
        latest[0] = env.reset()

    def step():
        began = env._begun[1]
        if began.any():
            mask = torch.tensor(began)[:, None]
            latest[0] = env.reset(latest[0].clone().set("_reset", mask))
        else:
            latest[0] = env.step(latest[0].clone().set("action", zeros))["next"]

    return env, reset, step


ADAPTERS = {
    "single": single,
    "numpy": vector("numpy"),
    "torch": vector("torch"),
    "sb3": sb3,
    "torchrl": torchrl,
}


def held(env):
    """The state that an adapter holds, and what it keeps beside it."""
    now = env._stateful._snapshot
    begun = env._begun[1].tobytes() if hasattr(env, "_begun") else b""
    arrays = (np.asarray(array).tobytes() for array in now.packed)
    return b"".join(arrays) + np.asarray(now.done).tobytes() + begun


@pytest.fixture
def interrupt():
    """Raise ``InterruptedStepError`` after so many seconds, by a real signal."""

    def stop(number, frame):
        raise InterruptedStepError

    before = signal.signal(signal.SIGALRM, stop)
    yield lambda seconds: signal.setitimer(signal.ITIMER_REAL, seconds)
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("name", ADAPTERS)
def test_a_signal_leaves_the_state_before_or_after_a_step(name, interrupt):
    env, reset, step = ADAPTERS[name]()
    reset()
    states = [held(env)]
    # Later steps take the ways of the earlier ones, with everything compiled.
    for _ in range(60):
        start = time.perf_counter()
        step()
        seconds = time.perf_counter() - start
        states.append(held(env))
    places = {state: i for i, state in enumerate(states)}
    assert len(places) == len(states)
    delays, arrived, moved = random.Random(0), 0, 0
    while arrived < SIGNALS:
        reset()
        count = 0
        try:
            interrupt(seconds * delays.uniform(0.01, 20.0))
            while count < 50:
                step()
                count += 1
            interrupt(0)
            continue
        except InterruptedStepError:
            arrived += 1
        now = places[held(env)]
        # `count` steps have been counted; one more may be done.
        assert now in (count, count + 1)
        moved += now > 0
        for _ in range(3):
            step()
        assert held(env) == states[now + 3]
    assert moved > SIGNALS // 4


def raising_at(last):
    """A trace function that raises at a line that a step passes, after so many others."""
    seen = 0

    def trace(frame, event, argument):
        nonlocal seen
        if not frame.f_code.co_filename.startswith((PACKAGE, compilation.__file__)):
            return None
        if event == "line":
            seen += 1
            if seen > last:
                raise InterruptedStepError
        return trace

    return trace


@pytest.mark.parametrize("name", ADAPTERS)
def test_an_exception_at_every_line_leaves_a_usable_environment(name):
    """As a debugger raises one: from its trace function, at each line in turn."""
    env, reset, step = ADAPTERS[name]()
    reset()
    step()
    lines = 0
    while True:
        reset()
        before = held(env)
        former = sys.gettrace()
        try:
            sys.settrace(raising_at(lines))
            step()
            break
        except InterruptedStepError:
            pass
        finally:
            sys.settrace(former)
        interrupted = held(env)
        if interrupted == before:
            step()
        after = held(env)
        reset()
        step()
        assert held(env) == after
        lines += 1
    assert lines > 5


def test_learning_goes_on_after_interruptions(interrupt):
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    env = pixelbrax_gym.SB3VecEnv(TASK, 4, obs_mode="state", episode_length=7)
    model = stable_baselines3.PPO("MlpPolicy", env, n_steps=8, batch_size=32, n_epochs=1, seed=0)
    model.learn(64)
    delays, interrupted = random.Random(0), 0
    while interrupted < 10:
        try:
            interrupt(delays.uniform(0.001, 0.05))
            model.learn(10_000)
        except InterruptedStepError:
            interrupted += 1
    model.learn(64)
    assert model.num_timesteps >= 64
