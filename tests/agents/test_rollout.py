"""Rollouts: what is put together again from single frames is what the agent saw."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import PixelEnv, VectorPixelEnv
from pixelbrax_jax.agents.on_policy import phasic
from pixelbrax_jax.agents.on_policy.algorithm import Decision, Experience, minibatch_times
from pixelbrax_jax.agents.on_policy.ppg import PPG, PPGConfig
from pixelbrax_jax.agents.rollout import collect, observations, shifted
from pixelbrax_jax.config import EnvConfig
from tests.envs.toy import Ball, limited

T, N = 15, 4
PARAMS = limited(7)
SPEED = jnp.array([1.0, 0.9, 0.1, -0.3])
"""The first two reach the end, the others the time limit."""


class FastBall(Ball):
    """Ends within a few steps; or at the time limit of 7, which is met at the step T - 1 too."""

    dt = 0.3


def choose(pixels, state, key):
    """Actions about ``SPEED``; what is seen is kept in place of a value."""
    action = SPEED[:, None] + 0.01 * jax.random.normal(key, (N, 1))
    return action, Decision(action, None, pixels)


CASES = {"one frame": (1, 0), "three frames": (3, 0), "three frames, shifted": (3, 2)}


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(case, id=name, marks=pytest.mark.slow if name == "three frames" else ())
        for name, case in CASES.items()
    ],
)
def played(request):
    """Two rollouts, one after the other."""
    stack, shift = request.param
    env = PixelEnv(FastBall(), height=10, width=12, frame_stack=stack)
    envs = VectorPixelEnv(env, N)
    play = jax.jit(lambda state, key: collect(envs, state, PARAMS, choose, key, T, shift))
    start, _ = envs.reset(jax.random.key(0), PARAMS)
    middle, first = play(start, jax.random.key(1))
    end, second = play(middle, jax.random.key(2))
    both = jax.tree.map(
        lambda *x: np.concatenate(x), *(r.replace(frames=()) for r in (first, second))
    )
    return SimpleNamespace(
        envs=envs, play=play, start=start, end=end, rollouts=(first, second), both=both,
        shift=shift, stack=stack, again=jax.jit(lambda f, t: observations(f, t, shift)),
    )  # fmt: skip


def test_a_rollout_is_what_stepping_by_hand_gives(played):
    state, seen, began, timesteps = played.start, [], [], []
    for action in played.both.choice.unclipped_action:
        seen.append(np.asarray(played.envs.obs(state)))
        began.append(np.asarray(state.done))
        state, timestep = played.envs.step(state, action, PARAMS)
        timesteps.append(timestep)
    timesteps = jax.tree.map(lambda *x: np.stack(x), *timesteps)
    assert timesteps.terminated[:, :2].any()
    assert timesteps.truncated[:, 2:].any()
    both = played.both
    for name in ("terminated", "truncated"):
        np.testing.assert_array_equal(getattr(both, name), getattr(timesteps, name))
    np.testing.assert_array_equal(both.valid, ~np.stack(began))
    np.testing.assert_array_equal(both.episode_length, timesteps.info["episode_length"])
    # Two programs round in their own ways.
    np.testing.assert_allclose(both.reward, timesteps.reward, atol=1e-6)
    np.testing.assert_allclose(both.episode_return, timesteps.info["episode_return"], atol=1e-5)
    if not played.shift:
        apart = np.abs(both.choice.value.astype(int) - np.stack(seen))
        assert np.mean(apart > 1) <= 0.01


def test_a_step_is_valid_unless_it_only_begins_an_episode(played):
    both = played.both
    assert both.valid[0].all()
    np.testing.assert_array_equal(both.valid[1:], ~both.done[:-1])
    np.testing.assert_array_equal(both.episode_length == 0, ~both.valid)
    assert (both.reward[~both.valid] == 0).all()
    # Among them an end at the last step of the first rollout: the second one begins with a reset.
    assert both.done[T - 1].any()


def test_metrics_of_episodes_are_those_of_their_ends(played):
    both, metrics = played.both, played.both.episode_metrics()
    assert int(metrics["episode/count"]) == both.done.sum()
    for name in ("return", "length"):
        expected = getattr(both, f"episode_{name}")[both.done].sum()
        assert float(metrics[f"episode/{name}_sum"]) == pytest.approx(expected, rel=1e-5)


def test_stacks_put_together_again_are_those_that_were_seen(played):
    everything = jnp.broadcast_to(jnp.arange(T)[:, None], (T, N))
    some = minibatch_times(jax.random.key(3), T, N, 3)[1]
    for rollout in played.rollouts:
        assert rollout.frames.pixels.shape == (T + played.stack - 1, N, 10, 12, 3)
        seen = np.asarray(rollout.choice.value)
        for times in (everything, some):
            # One environment after the other, times as they were asked for.
            again = np.reshape(
                played.again(rollout.frames, times), (N, len(times), *seen.shape[2:])
            )
            np.testing.assert_array_equal(again.swapaxes(0, 1), seen[times, np.arange(N)])
    # Stacks across a boundary of episodes have been among them, and they repeat a frame.
    starts = np.argwhere(~played.both.valid[:-1])
    assert len(starts)
    frames = played.both.choice.value.reshape(2 * T, N, 10, 12, played.stack, 3)
    for t, i in starts:
        first = frames[t + 1, i]
        np.testing.assert_array_equal(first, np.broadcast_to(first[..., -1:, :], first.shape))


def test_the_last_observation_is_that_of_the_state_left_behind(played):
    rollout = played.rollouts[-1]
    last = shifted(played.envs.obs(played.end), rollout.frames.shift, played.shift)
    np.testing.assert_array_equal(rollout.last_choice.value, last)


def test_chunks_of_the_buffer_are_the_rollouts(played):
    parts = 3
    config = PPGConfig(
        env=EnvConfig(height=10, width=12, frame_stack=played.stack), num_envs=N, num_steps=T,
        encoder="impala", random_shift=played.shift, num_minibatches=1, num_policy_phases=2,
        aux_minibatches=2 * parts,
    )  # fmt: skip
    entries = [phasic._entry(Experience(x, x.reward, x.reward)) for x in played.rollouts]
    buffer = jax.tree.map(lambda *x: jnp.stack(x), *entries)
    # Of each environment another chunk: the second and third of each rollout.
    which = np.array([1, 5, 2, 4])
    chunk = PPG(config, played.envs)._chunk(buffer, jnp.asarray(which), None)
    size = T // parts
    assert chunk.num_steps == size
    for i, number in enumerate(which):
        rollout, first = played.rollouts[number // parts], number % parts * size
        wanted = {
            "pixels": rollout.choice.value,
            "unclipped_action": rollout.choice.unclipped_action,
            "returns": rollout.reward,
            "weight": rollout.valid,
        }
        for name, expected in wanted.items():
            actual = np.asarray(getattr(chunk, name))
            actual = actual.reshape(N, size, *actual.shape[1:])[i]
            np.testing.assert_array_equal(actual, expected[first : first + size, i])


def test_an_environment_does_not_depend_on_its_neighbours(played):
    physics = played.start.sim.physics
    elsewhere = FastBall._state(jnp.float32(0.9), jnp.float32(0), jnp.float32(0), jnp.bool_(False))
    moved = jax.tree.map(lambda rows, one: rows.at[0].set(one), physics, elsewhere)
    start = played.start.replace(sim=played.start.sim.replace(physics=moved))
    _, changed = played.play(start, jax.random.key(1))
    first = played.rollouts[0]
    assert not np.array_equal(changed.reward[:, 0], first.reward[:, 0])
    for actual, expected in zip(
        *(jax.tree.leaves(r.replace(frames=(), last_choice=())) for r in (changed, first)),
        strict=True,
    ):
        np.testing.assert_array_equal(actual[:, 1:], expected[:, 1:])


def test_every_step_draws_its_own_actions(played):
    assert len({step.tobytes() for step in played.both.choice.unclipped_action}) == 2 * T


def test_shifts_repeat_the_edge():
    pixels = jnp.arange(2 * 4 * 5 * 1, dtype=jnp.uint8).reshape(2, 4, 5, 1)
    moved = np.asarray(shifted(pixels, jnp.array([[1, -2], [0, 3]]), 3))[..., 0]
    padded = [np.pad(np.asarray(p)[..., 0], 3, mode="edge") for p in pixels]
    # One pixel down and two to the left; three to the right.
    np.testing.assert_array_equal(moved[0], padded[0][3 - 1 : 7 - 1, 3 + 2 : 8 + 2])
    np.testing.assert_array_equal(moved[1], padded[1][3:7, 0:5])


def test_shifts_go_both_ways_and_reach_the_bound(played):
    shift = np.asarray(played.rollouts[0].frames.shift)
    assert np.abs(shift).max() <= played.shift
    assert not played.shift or not np.array_equal(shift, played.rollouts[1].frames.shift)


def test_minibatches_are_a_partition_with_every_environment_alike():
    times = np.asarray(minibatch_times(jax.random.key(0), T, N, 3))
    assert times.shape == (3, T // 3, N)
    whole = times.reshape(T, N)
    np.testing.assert_array_equal(np.sort(whole, axis=0), np.arange(T)[:, None].repeat(N, 1))
    assert len({tuple(column) for column in whole.T}) == N
    other = minibatch_times(jax.random.key(1), T, N, 3)
    assert not np.array_equal(times, other)
    # An environment's order does not depend on how many there are.
    np.testing.assert_array_equal(times[..., :2], minibatch_times(jax.random.key(0), T, 2, 3))
