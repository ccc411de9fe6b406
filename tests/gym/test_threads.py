"""Large batches on a CPU: the physics of their parts runs at the same time."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pixelbrax_gym.programs
import pixelbrax_jax as pb
from pixelbrax_gym import stateful, threads
from pixelbrax_gym.threads import call_on_threads
from pixelbrax_jax.envs import vector
from tests.gym.conftest import ID, SIZE, TASK

NUM_ENVS = 24

pytestmark = pytest.mark.skipif(jax.default_backend() != "cpu", reason="only done on a CPU")


@pytest.fixture
def make_chunked(monkeypatch):
    """A function that makes 24 environments whose physics has three chunks, on three cores."""
    monkeypatch.setattr(vector, "_CHUNK", 8)
    monkeypatch.setattr(threads, "num_cores", lambda: 3)
    stateful._programs.cache_clear()
    made = []

    def make(**options):
        options = SIZE | {"episode_length": 1000} | options
        made.append(gymnasium.make_vec(ID, num_envs=NUM_ENVS, output="jax", **options))
        return made[-1]

    yield make
    for env in made:
        env.close()
    stateful._programs.cache_clear()


def actions(count, seed=0):
    # The first chunk stays on its feet, others end episodes.
    rows = np.linspace(-0.2, 1.0, NUM_ENVS, dtype=np.float32)[:, None]
    jitter = np.random.default_rng(seed).uniform(-0.05, 0.05, (count, NUM_ENVS, 1))
    return (rows + jitter).astype(np.float32)


def assert_same(one, other):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("mode", ["next_step", "same_step"])
@pytest.mark.parametrize("distractors", [(), (pb.distractors.Camera(scale=0.2),)])
def test_chunks_in_threads_change_nothing(make_chunked, mode, distractors):
    """Also where episodes end in one chunk and not in another."""
    envs = make_chunked(autoreset_mode=mode, distractors=distractors)
    env, params = pb.make(TASK, **SIZE | {"episode_length": 1000, "distractors": distractors})
    venv = pb.VectorPixelEnv(env, NUM_ENVS, mode)
    step = jax.jit(venv.step, compiler_options=pb.compiler_options())
    envs.reset(seed=0)
    state, _ = venv.reset(jax.vmap(jax.random.key)(np.arange(NUM_ENVS)), params)
    ended = np.zeros(NUM_ENVS, bool)
    for action in actions(24):
        obs, reward, terminated, truncated, infos = envs.step(action)
        state, timestep = step(state, action, params)
        for name, value in timestep.info.items():
            theirs = infos[name]
            if isinstance(value, dict):
                theirs = {key: theirs[key] for key in value}
            assert_same(theirs, value)
        assert_same(
            (obs, reward, terminated, truncated),
            (timestep.obs, timestep.reward, timestep.terminated, timestep.truncated),
        )
        ended |= np.asarray(terminated)
    assert ended.any()
    assert not ended[:8].any()
    programs = envs.unwrapped._stateful._programs
    assert len(programs.compiled_advance) == programs.finish._cache_size() == 1
    assert programs.step_at_once._cache_size() == 0


def test_actions_of_half_precision(make_chunked):
    envs, other = make_chunked(), make_chunked()
    envs.reset(seed=0), other.reset(seed=0)
    for action in actions(3):
        half = jnp.asarray(action, jnp.bfloat16)
        assert_same(envs.step(half)[:4], other.step(np.asarray(half, np.float32))[:4])


def test_environments_that_differ_in_what_is_static(make_chunked):
    """They share programs but for what is compiled anew."""
    for options in ({}, {"shadows": True}, {"look": "original"}):
        envs = make_chunked(**options)
        envs.reset(seed=0)
        envs.step(actions(1)[0])


def test_a_context_of_the_caller_compiles_nothing_in_the_threads(make_chunked, monkeypatch):
    envs = make_chunked()
    envs.reset(seed=0)
    envs.step(actions(1)[0])
    programs = envs.unwrapped._stateful._programs
    (compiled,) = programs.compiled_advance.values()
    called = []

    def call(program, calls):
        called.append(program)
        return call_on_threads(program, calls)

    monkeypatch.setattr(pixelbrax_gym.programs, "call_on_threads", call)
    with jax.default_device(jax.devices()[0]), jax.default_matmul_precision("highest"):
        envs.step(actions(1)[0])
    assert called == [compiled]


def test_a_failed_step_leaves_everything_as_it_was(make_chunked):
    envs, other = make_chunked(), make_chunked()
    envs.reset(seed=0), other.reset(seed=0)
    first, second = actions(2)
    assert_same(envs.step(first), other.step(first))
    compiled = envs.unwrapped._stateful._programs.compiled_advance
    ((kind, program),) = compiled.items()

    def fails(state, action, params, start):
        if start == 8:
            raise RuntimeError("out of memory")
        return program(state, action, params, start)

    compiled[kind] = fails
    with pytest.raises(RuntimeError, match="out of memory"):
        envs.step(second)
    compiled[kind] = program
    assert_same(envs.step(second), other.step(second))


def test_two_environments_step_from_two_threads(make_chunked):
    envs, other = make_chunked(), make_chunked()
    plan = actions(20)

    def run(env):
        env.reset(seed=0)
        return [env.step(action)[0] for action in plan]

    alone = run(other)
    with ThreadPoolExecutor(2) as pool:
        one, two = pool.map(run, (envs, other))
    assert_same(one, alone)
    assert_same(two, alone)


def test_autoreset_disabled(make_chunked):
    envs = make_chunked(autoreset_mode="disabled", episode_length=2)
    envs.reset(seed=0)
    action = np.zeros((NUM_ENVS, 1), np.float32)
    for _ in range(2):
        truncated = envs.step(action)[3]
    assert truncated.all()
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(action)


@pytest.mark.parametrize("cores", [1, 2, 3, 16])
def test_calls_are_dealt_to_the_cores_and_keep_their_order(monkeypatch, cores):
    monkeypatch.setattr(threads, "num_cores", lambda: cores)
    seen = {}

    def program(number):
        seen[number] = threading.get_ident()
        return number

    for _ in range(3):
        assert call_on_threads(program, [(i,) for i in range(5)]) == [0, 1, 2, 3, 4]
        assert len(set(seen.values())) == min(cores, 5)
        assert seen[0] == threading.get_ident()


def test_of_several_errors_one_is_raised_and_no_thread_is_left(monkeypatch):
    monkeypatch.setattr(threads, "num_cores", lambda: 2)
    made = []

    def program(number):
        made.append(number)
        if number in (1, 2):
            raise ValueError(f"call {number} failed")

    with pytest.raises(ValueError, match="call 2 failed"):
        call_on_threads(program, [(i,) for i in range(4)])
    assert sorted(made) == [0, 1, 2]


@pytest.mark.parametrize("failing", [0, 2])
def test_an_error_of_any_call_is_raised(monkeypatch, failing):
    monkeypatch.setattr(threads, "num_cores", lambda: 3)

    def program(number):
        if number == failing:
            raise ValueError(f"call {number} failed")
        return number

    with pytest.raises(ValueError, match=f"call {failing} failed"):
        call_on_threads(program, [(i,) for i in range(3)])


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cannot choose cores here")
def test_cores_are_those_that_the_process_may_use():
    allowed = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(allowed)})
        assert threads.num_cores() == 1
    finally:
        os.sched_setaffinity(0, allowed)
