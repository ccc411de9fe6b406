"""Replay, targets and losses of off-policy algorithms, against loops in NumPy."""

from __future__ import annotations

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax.agents.off_policy.config import DrQv2Config
from pixelbrax_jax.agents.off_policy.drqv2 import noisy, projected
from pixelbrax_jax.agents.off_policy.replay import Replay
from pixelbrax_jax.agents.presets import TASK_SETTINGS, preset
from pixelbrax_jax.agents.rollout import Frames, Rollout
from tests.agents.small import REPLAY, SMALL

NUM_ENVS, SLOTS, NUM_STEPS, STACK, GAMMA = 4, 12, 3, 3, 0.9


class Story:
    """Random episodes: what happened in each step, and what was seen before it."""

    def __init__(self, length: int) -> None:
        rng = np.random.default_rng(0)
        shape = (length, NUM_ENVS)
        self.frame = np.zeros((*shape, 2, 2, 3), np.uint8)
        self.stack = np.zeros((*shape, 2, 2, 3 * STACK), np.uint8)
        self.action = rng.uniform(-1, 1, (*shape, 1)).astype(np.float32)
        self.reward = rng.normal(size=shape).astype(np.float32)
        self.terminated = rng.random(shape) < 0.15
        self.truncated = ~self.terminated & (rng.random(shape) < 0.15)
        self.valid = np.ones(shape, bool)
        for env in range(NUM_ENVS):
            frames = None
            for t in range(length):
                frame = rng.integers(0, 256, (2, 2, 3), np.uint8)
                resets = t > 0 and self.done[t - 1, env]
                begins = t == 0 or not self.valid[t - 1, env]
                # The step behind an end only resets.
                self.valid[t, env] = not resets
                if resets:
                    self.reward[t, env] = 0.0
                    self.terminated[t, env] = self.truncated[t, env] = False
                frames = [frame] * STACK if begins else [*frames[1:], frame]
                self.frame[t, env], self.stack[t, env] = frame, np.concatenate(frames, -1)

    @property
    def done(self) -> np.ndarray:
        return self.terminated | self.truncated

    def rollout(self, first: int) -> Rollout:
        rows = slice(first, first + NUM_STEPS)
        frames = Frames(pixels=jnp.asarray(self.frame[rows]), age=None, shift=None, state=None)
        return Rollout(
            frames=frames, choice=self.action[rows], last_choice=None, reward=self.reward[rows],
            terminated=self.terminated[rows], truncated=self.truncated[rows],
            valid=self.valid[rows], episode_return=None, episode_length=None,
        )  # fmt: skip

    def replay(self, length: int) -> Replay:
        frame = jax.ShapeDtypeStruct((2, 2, 3), jnp.uint8)
        replay = Replay.empty(NUM_ENVS, SLOTS, frame, 1)
        for first in range(0, length, NUM_STEPS):
            replay = replay.add(self.rollout(first))
        return replay

    def transition(self, env: int, t: int, n_step: int):
        """Return reward, discount and the time of the observation that bootstraps."""
        total, discount = 0.0, 1.0
        for k in range(t, t + n_step):
            total += discount * self.reward[k, env]
            discount *= GAMMA
            if self.terminated[k, env]:
                return total, 0.0, k + 1
            if self.truncated[k, env]:
                break
        return total, discount, k + 1


LENGTH = 30
STORY = Story(LENGTH)


@pytest.mark.parametrize("n_step", [1, 2, 5])
def test_transitions_are_those_of_the_episodes(n_step):
    replay = STORY.replay(LENGTH)
    times = np.arange(LENGTH - SLOTS + STACK - 1, LENGTH - n_step)
    env, time = (x.ravel()[None] for x in np.meshgrid(np.arange(NUM_ENVS), times))
    batch = replay.transitions(jnp.asarray(env), jnp.asarray(time), STACK, n_step, GAMMA)
    ends = set()
    for i, (e, t) in enumerate(zip(env[0], time[0], strict=True)):
        assert batch.weight[i] == STORY.valid[t, e]
        np.testing.assert_array_equal(batch.pixels[i], STORY.stack[t, e])
        np.testing.assert_array_equal(batch.action[i], STORY.action[t, e])
        if STORY.valid[t, e]:
            reward, discount, later = STORY.transition(e, t, n_step)
            np.testing.assert_allclose(batch.reward[i], reward, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(batch.discount[i], discount, rtol=1e-6)
            np.testing.assert_array_equal(batch.next_pixels[i], STORY.stack[later, e])
            ends.add((discount == 0.0, later - t))
    assert {(True, 1), (False, n_step)} <= ends, "a termination, and a whole return"


@pytest.mark.parametrize(("length", "oldest"), [(9, 0), (LENGTH, LENGTH - SLOTS)])
@pytest.mark.parametrize("batch_size", [2, 6, 64])
def test_samples_lie_within_what_is_stored(monkeypatch, length, oldest, batch_size):
    drawn = {}
    monkeypatch.setattr(
        Replay, "transitions", lambda self, env, time, *_: drawn.update(env=env, time=time)
    )
    replay = STORY.replay(length)
    for seed in range(20):
        replay.sample(jax.random.key(seed), batch_size, STACK, 2, GAMMA)
        assert drawn["time"].size == batch_size
        assert drawn["time"].min() >= oldest + STACK - 1
        assert drawn["time"].max() + 2 <= length - 1, "the last observation is stored"
        assert drawn["env"].max() < NUM_ENVS // drawn["env"].shape[0]
    assert int(replay.size) == NUM_ENVS * min(length, SLOTS)


def test_noise_is_clipped_and_bounded_and_lets_gradients_pass():
    mean = jnp.linspace(-1.0, 1.0, 201)[:, None]
    key = jax.random.key(0)
    action = noisy(mean, 1.0, key)
    noise = jax.random.normal(key, mean.shape)
    np.testing.assert_allclose(action, np.clip(mean + noise, -1, 1), atol=2e-6)
    assert np.abs(action).max() < 1.0
    clipped = noisy(mean, 1.0, key, 0.3)
    np.testing.assert_allclose(clipped, np.clip(mean + np.clip(noise, -0.3, 0.3), -1, 1), atol=2e-6)
    slope = jax.grad(lambda mean: noisy(mean, 1.0, key, 0.3).sum())(mean)
    np.testing.assert_array_equal(slope, 1.0)


def test_a_projection_is_that_of_a_loop_and_keeps_sum_and_mean():
    rng = np.random.default_rng(0)
    support = np.linspace(-2.0, 3.0, 11, dtype=np.float32)
    probabilities = rng.dirichlet(np.ones(11), 6)
    values = rng.uniform(-3.0, 4.0, (6, 11))
    found = np.asarray(projected(jnp.asarray(probabilities), jnp.asarray(values), support))
    expected = np.zeros((6, 11))
    for row in range(6):
        for p, value in zip(probabilities[row], values[row], strict=True):
            place = (np.clip(value, -2.0, 3.0) + 2.0) / 0.5
            low = min(int(place), 9)
            expected[row, low] += p * (low + 1 - place)
            expected[row, low + 1] += p * (place - low)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_allclose(found.sum(-1), 1.0, atol=1e-5)
    mean = (probabilities * np.clip(values, -2.0, 3.0)).sum(-1)
    np.testing.assert_allclose(found @ support, mean, atol=1e-5)


CONFIG = DrQv2Config(env=SMALL["env"], encoder="small", num_envs=4, num_steps=8, **REPLAY)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"batch_size": 64}, "batch_size=64 must be at most learning_starts=32"),
        ({"learning_starts": 65}, "learning_starts=65 must be at most buffer_size=64"),
        ({"n_step": 6}, "n_step=6 must be at most 5, the steps of an episode"),
        ({"n_step": 5, "num_envs": 8, "num_steps": 4}, "learning_starts=32 must be at least 56"),
        ({"total_steps": 32}, "learning_starts=32 must be below 32"),
        ({"replay_ratio": 0.01}, "replay_ratio=0.01 gives 0.32 updates per iteration"),
        ({"replay_ratio": 0.3}, "the nearest replay_ratio is 0.3125"),
        ({"replay_ratio": 0}, "replay_ratio must be a positive number, got 0"),
        ({"critic": "c51", "v_min": 20.0}, "c51 needs v_min below v_max"),
        ({"encoder": "impala"}, "unknown encoder: 'impala'; allowed: drq"),
        ({"state_critic": True}, "state_critic must be False"),
        (
            {"buffer_size": 100_000, "memory_budget_gb": 0.001},
            "the replay needs 97,200,000 bytes, but memory_budget_gb=0.001 allows 1,000,000; "
            "for frames alone the largest that fits is buffer_size=1024.",
        ),
    ],
)
def test_settings_that_contradict_each_other_are_told(settings, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        CONFIG.replace(**settings)


def test_the_largest_buffer_that_is_told_fits():
    assert CONFIG.replace(buffer_size=1024, memory_budget_gb=0.001).replay_bytes <= 1_000_000
    with pytest.raises(ValueError, match="buffer_size=1024"):
        CONFIG.replace(buffer_size=1025, memory_budget_gb=0.001)


def test_the_published_settings_make_an_update_every_second_step():
    for task, changes in TASK_SETTINGS["drqv2"]["drqv2"].items():
        config = preset("drqv2", "drqv2", task)
        assert (config.num_envs * config.num_steps, config.num_updates) == (2, 1)
        assert config.std_steps == changes["std_steps"]
    assert preset("drqv2", "drqv2", "dmc_walker_walk").n_step == 1
    with pytest.raises(ValueError, match="'procgen' has no settings for drqv2; use one of default"):
        preset("drqv2", "procgen")
