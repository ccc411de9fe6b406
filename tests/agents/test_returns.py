"""Advantages and the scale of rewards, against plain loops."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax.agents.on_policy.losses import RewardScaler, gae

T, N = 40, 16
GAMMA, LAMBDA = 0.97, 0.9


def episodes(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random ends: terminated, truncated, and valid, as mode ``next_step`` gives them."""
    terminated, truncated = np.zeros((2, T, N), bool)
    valid = np.ones((T, N), bool)
    for i in range(N):
        # Some environments are in the middle of an end when the rollout begins.
        begins = i % 4 == 0
        for t in range(T):
            valid[t, i] = not begins
            kind = rng.choice(3, p=[0.7, 0.15, 0.15])
            terminated[t, i] = not begins and kind == 1
            truncated[t, i] = not begins and kind == 2
            begins = terminated[t, i] or truncated[t, i]
    return terminated, truncated, valid


def advantage_by_definition(reward, value, last_value, terminated, truncated) -> np.ndarray:
    """Exponentially weighted sum of the errors of one episode, from each step to its end."""
    following = np.concatenate([value[1:], last_value[None]])
    result = np.zeros((T, N))
    for i in range(N):
        for t in range(T):
            weight = 1.0
            for k in range(t, T):
                error = reward[k, i] - value[k, i]
                if not terminated[k, i]:
                    error += GAMMA * following[k, i]
                result[t, i] += weight * error
                if terminated[k, i] or truncated[k, i]:
                    break
                weight *= GAMMA * LAMBDA
    return result


def experience(seed: int):
    rng = np.random.default_rng(seed)
    terminated, truncated, valid = episodes(rng)
    reward = np.where(valid, rng.normal(size=(T, N)), 0.0).astype(np.float32)
    value, last_value = rng.normal(size=(T, N)), rng.normal(size=N)
    values = value.astype(np.float32), last_value.astype(np.float32)
    return reward, *values, terminated, truncated, valid


@pytest.mark.parametrize("seed", range(3))
def test_gae_is_what_its_definition_says(seed):
    reward, value, last_value, terminated, truncated, valid = experience(seed)
    assert terminated.any()
    assert truncated.any()
    assert not valid.all()
    assert not (terminated & truncated).any()
    advantage, returns = gae(reward, value, last_value, terminated, truncated, GAMMA, LAMBDA)
    expected = advantage_by_definition(reward, value, last_value, terminated, truncated)
    np.testing.assert_allclose(advantage[valid], expected[valid], atol=2e-5)
    np.testing.assert_allclose(returns[valid], (expected + value)[valid], atol=2e-5)


@pytest.mark.parametrize(("terminated", "future"), [(False, 0.5 * 10), (True, 0)])
def test_a_time_limit_keeps_the_future_and_a_termination_ends_it(terminated, future):
    """A step with reward 1 and value 2 before an observation whose value is 10."""
    one = jnp.ones((1, 1))
    end = jnp.full((1, 1), terminated)
    advantage, _ = gae(one, 2 * one, 10 * one[0], end, ~end, 0.5, 0.9)
    assert float(advantage[0, 0]) == 1 + future - 2


def test_the_step_that_begins_an_episode_does_not_reach_the_one_before():
    reward, *others, valid = experience(7)
    changed = np.where(valid, reward, 1e6)
    one, two = (gae(jnp.asarray(r), *others, GAMMA, LAMBDA)[0] for r in (reward, changed))
    np.testing.assert_array_equal(one[valid], two[valid])


class Reference:
    """The scaler, with all returns ever seen in a list."""

    def __init__(self) -> None:
        self.discounted = np.zeros(N)
        self.seen: list[float] = []

    def __call__(self, reward, done, valid) -> np.ndarray:
        for t in range(T):
            for i in range(N):
                if not valid[t, i]:
                    continue
                self.discounted[i] = GAMMA * self.discounted[i] + reward[t, i]
                self.seen.append(self.discounted[i])
                if done[t, i]:
                    self.discounted[i] = 0.0
        return np.clip(reward / np.sqrt(np.var(self.seen) + 1e-8), -10, 10)


def test_rewards_are_divided_by_the_deviation_of_all_returns_seen():
    scaler, reference = RewardScaler.start(N), Reference()
    ended, crossing = np.zeros(N, bool), False
    for rollout in range(4):
        reward, _, _, terminated, truncated, valid = experience(rollout)
        # The step after an end begins an episode, across rollouts too.
        valid[0] = ~ended
        terminated[0] &= valid[0]
        truncated[0] &= valid[0]
        ended = terminated[-1] | truncated[-1]
        crossing |= bool((~ended).any())
        # A mean far from 0 and a growing scale: sums of squares alone would not do.
        reward = np.where(valid, 5 + (rollout + 1) * reward, 0.0)
        done = terminated | truncated
        expected = reference(reward, done, valid)
        scaler, scaled = scaler(
            jnp.asarray(reward, jnp.float32), jnp.asarray(done), jnp.asarray(valid), GAMMA
        )
        assert int(scaler.count) == len(reference.seen)
        np.testing.assert_allclose(scaler.mean, np.mean(reference.seen), rtol=1e-5)
        np.testing.assert_allclose(scaler.scale, np.std(reference.seen), rtol=1e-5)
        np.testing.assert_allclose(scaled, expected, rtol=1e-5)
    assert crossing


def test_a_reward_never_becomes_more_than_10():
    reward = jnp.zeros((T, N)).at[-1, 0].set(1e4).at[-1, 1].set(-1e4)
    done = valid = jnp.ones((T, N), bool)
    _, scaled = RewardScaler.start(N)(reward, done, valid, GAMMA)
    assert float(scaled[-1, 0]) == 10.0
    assert float(scaled[-1, 1]) == -10.0


def test_one_return_among_very_many_changes_nothing_nor_does_none():
    scaler = RewardScaler.start(N).replace(count=jnp.float32(2**32), square=jnp.float32(4.0))
    nothing = jnp.zeros((T, N), bool)
    after, _ = scaler(jnp.zeros((T, N)), nothing, nothing.at[3, 5].set(True), GAMMA)
    assert float(after.scale) == pytest.approx(2.0, rel=1e-6)
    scaler = scaler.replace(count=jnp.float32(9.0))
    after, _ = scaler(jnp.zeros((T, N)), nothing, nothing, GAMMA)
    assert (int(after.count), float(after.square)) == (9, 4.0)
