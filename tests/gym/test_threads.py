"""Large batches on a CPU: the physics of their parts runs at the same time."""

import os
import threading

import gymnasium
import jax
import numpy as np
import pytest

import pixelbrax_jax as pb
from pixelbrax_gym import stateful
from pixelbrax_gym.threads import call_on_threads
from tests.gym.conftest import ID, SIZE, TASK

NUM_ENVS = 24

pytestmark = pytest.mark.skipif(jax.default_backend() != "cpu", reason="only done on a CPU")


@pytest.fixture
def make_parts(monkeypatch):
    """A function that makes 24 environments whose physics has so many parts."""
    made = []

    def make(cores, **options):
        monkeypatch.setattr(stateful, "_LEAST_PART", 4)
        monkeypatch.setattr(stateful, "num_cores", lambda: cores)
        stateful._programs.cache_clear()
        made.append(gymnasium.make_vec(ID, num_envs=NUM_ENVS, output="jax", **(SIZE | options)))
        return made[-1]

    yield make
    for env in made:
        env.close()
    stateful._programs.cache_clear()


@pytest.mark.parametrize(
    ("num_envs", "cores", "parts"),
    [(1, 8, 1), (127, 8, 1), (128, 8, 2), (128, 1, 1), (256, 2, 2), (1000, 2, 2), (1000, 16, 10)],
)
def test_parts_are_equal_and_not_too_small(monkeypatch, num_envs, cores, parts):
    monkeypatch.setattr(stateful, "num_cores", lambda: cores)
    assert stateful._num_parts(num_envs) == parts


@pytest.mark.parametrize("mode", ["next_step", "same_step"])
def test_parts_change_nothing(make_parts, mode):
    """Also where episodes end in one part and not in another."""
    envs = make_parts(3, autoreset_mode=mode, episode_length=1000)
    env, params = pb.make(TASK, **(SIZE | {"episode_length": 1000}))
    venv = pb.VectorPixelEnv(env, NUM_ENVS, mode)
    step = jax.jit(venv.step, compiler_options=pb.compiler_options())
    envs.reset(seed=0)
    state, _ = venv.reset(jax.vmap(jax.random.key)(np.arange(NUM_ENVS)), params)
    action = np.linspace(-0.2, 1.0, NUM_ENVS, dtype=np.float32)[:, None]
    ended = np.zeros(NUM_ENVS, bool)
    for _ in range(24):
        obs, reward, terminated, truncated, infos = envs.step(action)
        state, timestep = step(state, action, params)
        ours = (obs, reward, terminated, truncated, infos["episode_length"])
        theirs = (
            timestep.obs,
            timestep.reward,
            timestep.terminated,
            timestep.truncated,
            timestep.info["episode_length"],
        )
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(a, b)
        ended |= np.asarray(terminated)
    assert ended.any()
    assert not ended[:8].any()
    programs = envs.unwrapped._stateful._programs
    assert programs.advance_part._cache_size() == programs.finish_step._cache_size() == 1
    assert programs.step_at_once._cache_size() == 0


def test_autoreset_disabled(make_parts):
    envs = make_parts(2, autoreset_mode="disabled", episode_length=2)
    envs.reset(seed=0)
    action = np.zeros((NUM_ENVS, 1), np.float32)
    for _ in range(2):
        truncated = envs.step(action)[3]
    assert truncated.all()
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(action)


def test_every_call_has_a_thread_of_its_own():
    names = []

    def program(number):
        names.append(threading.get_ident())
        return number

    for _ in range(3):
        names.clear()
        assert call_on_threads(program, [(i,) for i in range(4)]) == [0, 1, 2, 3]
        assert len(set(names)) == 4
        assert threading.get_ident() in names


def test_an_error_of_any_call_is_raised():
    def program(number):
        if number == 2:
            raise ValueError("the third call failed")
        return number

    with pytest.raises(ValueError, match="the third call failed"):
        call_on_threads(program, [(i,) for i in range(3)])


def test_threads_know_the_default_device():
    """A program compiled under another default device is not compiled again in each thread."""
    program = jax.jit(lambda x: x + 1)
    with jax.default_device(jax.devices()[0]):
        results = call_on_threads(program, [(np.float32(i),) for i in range(3)])
    assert [float(x) for x in results] == [1.0, 2.0, 3.0]
    assert program._cache_size() == 1


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cannot choose cores here")
def test_cores_are_those_that_the_process_may_use():
    allowed = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(allowed)})
        assert stateful.num_cores() == 1
    finally:
        os.sched_setaffinity(0, allowed)
