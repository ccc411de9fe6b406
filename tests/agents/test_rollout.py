"""Rollouts: what is put together again from single frames is what the agent saw."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import PixelEnv, VectorPixelEnv
from pixelbrax_jax.agents.config import TrainConfig
from pixelbrax_jax.agents.networks.distributions import Normal
from pixelbrax_jax.agents.on_policy import phasic
from pixelbrax_jax.agents.on_policy.experience import Experience
from pixelbrax_jax.agents.on_policy.rollout import (
    Decision,
    collect,
    minibatch_times,
    observations,
    shifted,
)
from pixelbrax_jax.config import EnvConfig
from tests.envs.toy import Ball, limited

T, N = 15, 4
PARAMS = limited(7)
SPEED = jnp.array([1.0, 0.9, 0.1, -0.3])
"""The first two reach the end, the others the time limit."""


class FastBall(Ball):
    """Ends within a few steps; or at the time limit of 7, which is met at the step T - 1 too."""

    dt = 0.3


def decide(pixels, state, key) -> Decision:
    """Actions about ``SPEED``; what is seen is kept in place of a value."""
    raw = SPEED[:, None] + 0.01 * jax.random.normal(key, (N, 1))
    brightness = pixels.astype(jnp.float32).mean((1, 2, 3))
    return Decision(raw, raw, brightness, pixels)


CASES = {"one frame": (1, 0), "three frames": (3, 0), "three frames, shifted": (3, 2)}


@pytest.fixture(scope="module", params=CASES.values(), ids=CASES)
def played(request):
    """Two rollouts, one after the other."""
    stack, shift = request.param
    env = PixelEnv(FastBall(), height=10, width=12, frame_stack=stack)
    envs = VectorPixelEnv(env, N)
    play = jax.jit(lambda state, key: collect(envs, state, PARAMS, decide, key, T, shift))
    start, _ = envs.reset(jax.random.key(0), PARAMS)
    middle, first = play(start, jax.random.key(1))
    end, second = play(middle, jax.random.key(2))
    return SimpleNamespace(
        envs=envs, play=play, start=start, end=end, rollouts=(first, second), shift=shift,
        stack=stack, again=jax.jit(lambda f, t: observations(f, t, shift)),
    )  # fmt: skip


def step_by_step(played) -> SimpleNamespace:
    """The same actions in a plain loop over ``step``: stacks before each step, and timesteps."""
    state, seen, timesteps, began = played.start, [], [], []
    for rollout in played.rollouts:
        for t in range(T):
            seen.append(np.asarray(played.envs.obs(state)))
            began.append(np.asarray(state.done))
            state, timestep = played.envs.step(state, rollout.unclipped_action[t], PARAMS)
            timesteps.append(timestep)
    timesteps = jax.tree.map(lambda *x: np.stack(x), *timesteps)
    return SimpleNamespace(seen=np.stack(seen), began=np.stack(began), timesteps=timesteps)


def of_both(played, name: str) -> np.ndarray:
    return np.concatenate([getattr(rollout, name) for rollout in played.rollouts])


def test_a_rollout_is_what_stepping_by_hand_gives(played):
    expected = step_by_step(played)
    timesteps = expected.timesteps
    assert timesteps.terminated[:, :2].any()
    assert timesteps.truncated[:, 2:].any()
    for name in ("terminated", "truncated"):
        np.testing.assert_array_equal(of_both(played, name), getattr(timesteps, name))
    np.testing.assert_array_equal(of_both(played, "valid"), ~expected.began)
    length = timesteps.info["episode_length"]
    np.testing.assert_array_equal(of_both(played, "episode_length"), length)
    # Two programs round in their own ways.
    np.testing.assert_allclose(of_both(played, "reward"), timesteps.reward, atol=1e-6)
    np.testing.assert_allclose(
        of_both(played, "episode_return"), timesteps.info["episode_return"], atol=1e-5
    )
    if not played.shift:
        apart = np.abs(of_both(played, "value").astype(int) - expected.seen)
        assert np.mean(apart > 1) <= 0.01


def test_a_step_is_valid_unless_it_only_begins_an_episode(played):
    done, valid = of_both(played, "done"), of_both(played, "valid")
    assert valid[0].all()
    np.testing.assert_array_equal(valid[1:], ~done[:-1])
    length, reward = of_both(played, "episode_length"), of_both(played, "reward")
    np.testing.assert_array_equal(length == 0, ~valid)
    assert (reward[~valid] == 0).all()
    # Among them an end at the last step of the first rollout: the second one begins with a reset.
    assert done[T - 1].any()


def test_stacks_put_together_again_are_those_that_were_seen(played):
    everything = jnp.broadcast_to(jnp.arange(T)[:, None], (T, N))
    for rollout in played.rollouts:
        seen = np.asarray(rollout.value)
        again = played.again(rollout.frames, everything)
        # One environment after the other.
        np.testing.assert_array_equal(
            np.reshape(again, (N, T, *seen.shape[2:])).swapaxes(0, 1), seen
        )
        assert rollout.frames.pixels.shape == (T + played.stack - 1, N, 10, 12, 3)
    # Stacks across a boundary of episodes have been among them, and they repeat a frame.
    starts = np.argwhere(~of_both(played, "valid")[:-1])
    assert len(starts)
    frames = of_both(played, "value").reshape(2 * T, N, 10, 12, played.stack, 3)
    for t, i in starts:
        first = frames[t + 1, i]
        np.testing.assert_array_equal(first, np.broadcast_to(first[..., -1:, :], first.shape))


def test_stacks_of_any_times_come_in_the_order_asked_for(played):
    rollout = played.rollouts[1]
    times = minibatch_times(jax.random.key(3), T, N, 3)[1]
    again = np.reshape(played.again(rollout.frames, times), (N, T // 3, 10, 12, -1))
    seen = np.asarray(rollout.value)
    for row, per_env in enumerate(np.asarray(times)):
        for i, t in enumerate(per_env):
            np.testing.assert_array_equal(again[i, row], seen[t, i])


def test_the_last_observation_is_that_of_the_state_left_behind(played):
    rollout = played.rollouts[-1]
    last = shifted(played.envs.obs(played.end), rollout.frames.shift, played.shift)
    np.testing.assert_array_equal(rollout.last_value, last)


def test_chunks_of_the_buffer_are_the_rollouts(played):
    config = TrainConfig(
        env=EnvConfig(height=10, width=12, frame_stack=played.stack), num_envs=N, num_steps=T,
        encoder="impala", random_shift=played.shift, num_minibatches=1,
    )  # fmt: skip
    experiences = [Experience(x, x.reward, x.reward) for x in played.rollouts]
    buffer = jax.tree.map(
        lambda x: jnp.zeros((2, *x.shape), x.dtype), phasic._entry(experiences[0])
    )
    for slot, experience in enumerate(experiences):
        buffer = phasic.remember(buffer, jnp.uint32(slot), experience)
    parts, policy = 3, Normal(jnp.zeros(()), jnp.ones(()), False)
    # Of each environment another chunk: the second and third of each rollout.
    which = np.array([1, 5, 2, 4])
    chunk = phasic._chunk(config, buffer, jnp.asarray(which), parts, policy)
    size = T // parts
    assert chunk.num_steps == size
    fields = {"pixels": "value", "returns": "reward", "weight": "valid"}
    for name, field in (fields | {"unclipped_action": "unclipped_action"}).items():
        actual = np.asarray(getattr(chunk, name))
        actual = actual.reshape(N, size, *actual.shape[1:])
        for i, number in enumerate(which):
            rollout, first = number // parts, number % parts * size
            expected = getattr(played.rollouts[rollout], field)[first : first + size, i]
            np.testing.assert_array_equal(actual[i], expected)


def test_an_environment_does_not_depend_on_its_neighbours(played):
    physics = played.start.sim.physics
    elsewhere = FastBall._state(jnp.float32(0.9), jnp.float32(0), jnp.float32(0), jnp.bool_(False))
    moved = jax.tree.map(lambda rows, one: rows.at[0].set(one), physics, elsewhere)
    start = played.start.replace(sim=played.start.sim.replace(physics=moved))
    _, changed = played.play(start, jax.random.key(1))
    first = played.rollouts[0]
    assert not np.array_equal(changed.reward[:, 0], first.reward[:, 0])
    names = ("reward", "done", "valid", "value", "log_prob", "episode_return", "unclipped_action")
    for name in names:
        actual, expected = getattr(changed, name), getattr(first, name)
        np.testing.assert_array_equal(actual[:, 1:], expected[:, 1:])


def test_every_step_draws_its_own_actions(played):
    raw = of_both(played, "unclipped_action")
    assert len({step.tobytes() for step in raw}) == 2 * T


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
