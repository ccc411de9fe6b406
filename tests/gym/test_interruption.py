"""An exception that arrives at any time leaves the state before a step or the one after."""

from __future__ import annotations

import random
import signal
import sys
import time

import pytest

import pixelbrax_gym
import pixelbrax_jax
from pixelbrax_jax import compilation
from tests.gym.adapters import ADAPTERS
from tests.gym.conftest import TASK

# JAX calls Python from within, e.g. in callbacks of weak references: what is raised there is lost.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

SIGNALS = 60
"""Of each adapter."""
PACKAGE = pixelbrax_gym.__path__[0]


class InterruptedStepError(KeyboardInterrupt):
    """Raised by the handler of a timer's signal."""


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
    adapter = ADAPTERS[name](episode_length=7)
    adapter.reset()
    states = [adapter.held()]
    # Later steps take the ways of the earlier ones, with everything compiled.
    for _ in range(60):
        start = time.perf_counter()
        adapter.call()
        seconds = time.perf_counter() - start
        states.append(adapter.held())
    places = {state: i for i, state in enumerate(states)}
    assert len(places) == len(states)
    delays, arrived, moved = random.Random(0), 0, 0
    while arrived < SIGNALS:
        adapter.reset()
        count = 0
        try:
            interrupt(seconds * delays.uniform(0.01, 20.0))
            while count < 50:
                adapter.call()
                count += 1
            interrupt(0)
            continue
        except InterruptedStepError:
            arrived += 1
        now = places[adapter.held()]
        # `count` steps have been counted; one more may be done.
        assert now in (count, count + 1)
        moved += now > 0
        for _ in range(3):
            adapter.call()
        assert adapter.held() == states[now + 3]
    assert moved > SIGNALS // 4


def raising_at(last, files=(PACKAGE, compilation.__file__)):
    """A trace function that raises at a line that a call passes, after so many others."""
    seen = 0

    def trace(frame, event, argument):
        nonlocal seen
        if not frame.f_code.co_filename.startswith(files):
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
    adapter = ADAPTERS[name](episode_length=7)
    adapter.reset()
    adapter.call()
    lines = 0
    while True:
        adapter.reset()
        before = adapter.held()
        former = sys.gettrace()
        try:
            sys.settrace(raising_at(lines))
            adapter.call()
            break
        except InterruptedStepError:
            pass
        finally:
            sys.settrace(former)
        if adapter.held() == before:
            adapter.call()
        after = adapter.held()
        adapter.reset()
        adapter.call()
        assert adapter.held() == after
        lines += 1
    assert lines > 5


def test_an_exception_while_a_program_is_made_leaves_a_usable_environment():
    """At lines of the packages that JAX runs to make a program; the next call makes it anew."""
    files = (PACKAGE, pixelbrax_jax.__path__[0])
    options = {"obs_mode": "state", "width": 33}  # of no other test, so nothing is compiled
    adapter = ADAPTERS["numpy"](**options)
    lines, raised = 1, 0
    former = sys.gettrace()
    while True:
        try:
            sys.settrace(raising_at(lines, files))
            adapter.reset()
            adapter.call()
            break
        except InterruptedStepError:
            raised += 1
        finally:
            sys.settrace(former)
        lines += 1 + lines // 2
    assert raised > 10
    other = ADAPTERS["numpy"](**options)
    other.reset()
    other.call()
    assert adapter.held() == other.held()


def test_learning_goes_on_after_interruptions(interrupt):
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    env = pixelbrax_gym.SB3VecEnv(TASK, 4, obs_mode="state", episode_length=7)
    model = stable_baselines3.PPO("MlpPolicy", env, n_steps=8, batch_size=32, n_epochs=1, seed=0)
    # Twice: only later calls reset an environment that has been stepped. Everything is compiled
    # then. JAX has `except:` where it makes programs, in `jax._src.core.is_constant_dim` for one,
    # so that an interruption there is lost and the program that JAX keeps is wrong.
    for _ in range(2):
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
