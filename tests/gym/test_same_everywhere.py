"""The same seed and actions give the same episodes through every adapter, from first to last."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pixelbrax_jax
from tests.gym.adapters import ACTIONS, ADAPTERS, OPTIONS, Event, Vector, row_of
from tests.gym.conftest import TASK

CALLS = 100
ADAPTERS_AND_JAX = ADAPTERS | {
    f"{output}-{mode}": lambda mode=mode, output=output: Vector(mode, output=output)
    for output in ("numpy", "torch")
    for mode in ("next_step", "same_step", "disabled")
    # Two are in `ADAPTERS`.
    if (output, mode) not in {("numpy", "next_step"), ("torch", "same_step")}
}


def sorted_by_episode(events):
    """Of each environment, its complete episodes as lists of events."""
    rows = [[] for _ in range(3)]
    for event in events:
        if event.is_first:
            rows[event.row].append([])
        rows[event.row][-1].append(event)
    return [episodes[:-1] for episodes in rows]


def through_jax(mode):
    env, params = pixelbrax_jax.make(TASK, **OPTIONS)
    envs = pixelbrax_jax.VectorPixelEnv(env, 3, mode)
    state, timestep = envs.reset(jax.vmap(jax.random.key)(jnp.arange(3)), params)
    events = [Event(i, True, row_of(timestep.obs, i)) for i in range(3)]
    ended = np.zeros(3, bool)
    for _ in range(CALLS):
        state, timestep = envs.step(state, ACTIONS, params)
        flags = timestep.terminated, timestep.truncated
        done = np.asarray(flags[0] | flags[1])
        info = timestep.info.get("final_info", timestep.info)
        last = timestep.info.get("final_obs", timestep.obs)
        parts = (last, timestep.reward, *flags, info["episode_length"])
        for i in range(3):
            begins = ended[i] if mode == "next_step" else done[i]
            if not (mode == "next_step" and begins):
                obs, reward, *rest = row_of(parts, i)
                events.append(Event(i, False, obs, float(reward), *rest))
            if begins:
                events.append(Event(i, True, row_of(timestep.obs, i)))
        ended = done
    return sorted_by_episode(events)


@pytest.fixture(scope="module")
def expected():
    return through_jax("next_step")


def check(actual, expected, pixels_atol=0, atol=0.0):
    close = np.testing.assert_allclose
    for ours, theirs in zip(actual, expected, strict=True):
        shared = min(len(ours), len(theirs))
        assert shared >= 3, "several episodes are compared"
        for one, other in zip(ours[:shared], theirs[:shared], strict=True):
            for left, right in zip(one, other, strict=True):
                close(np.int32(left.obs["pixels"]), right.obs["pixels"], rtol=0, atol=pixels_atol)
                close(left.obs["state"], right.obs["state"], rtol=0, atol=atol)
                close(left.reward, right.reward, rtol=0, atol=atol)
                assert left[4:6] == right[4:6]
                assert left.length in (right.length, -1), "an unfinished one is not always told"


def test_episodes_are_of_all_kinds(expected):
    lengths = [[len(episode) for episode in episodes] for episodes in expected]
    assert set(lengths[0]) == {21}, "a first frame and twenty more"
    assert all(length < 21 for length in lengths[1] + lengths[2])


def test_jax_same_step(expected):
    check(through_jax("same_step"), expected)


@pytest.mark.parametrize("name", ADAPTERS_AND_JAX)
def test_every_adapter(name, expected):
    adapter = ADAPTERS_AND_JAX[name]()
    events = adapter.first(adapter.reset(seed=0))
    for _ in range(CALLS):
        events += adapter.call()[0]
    if name == "single":
        check(sorted_by_episode(events)[:1], expected[:1], pixels_atol=1, atol=1e-6)
    else:
        # Programs of another mode may round sums otherwise.
        is_other = getattr(adapter, "mode", "") == "disabled"
        check(sorted_by_episode(events), expected, atol=1e-6 * is_other)
    adapter.env.close()
