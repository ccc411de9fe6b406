"""Losses, advantages, scaled rewards and the optimiser's step, against plain calculations."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from pixelbrax_jax.agents.networks.distributions import Normal
from pixelbrax_jax.agents.on_policy.config import OnPolicyConfig
from pixelbrax_jax.agents.on_policy.losses import (
    Batch,
    RewardScaler,
    clipped_value_loss,
    gae,
    normalized,
    policy_loss,
    value_loss,
)
from pixelbrax_jax.agents.optimizer import Optimizer

B = 12
CONFIG = OnPolicyConfig(clip_coef=0.2, ent_coef=0.03, normalize_advantage="none")
KEY = jax.random.key(0)


def batch(seed: int = 0) -> Batch:
    rng = np.random.default_rng(seed)
    # A third of the samples teaches nothing.
    weight = np.arange(B) % 3 > 0
    numbers = {
        name: jnp.asarray(rng.normal(size=B), jnp.float32)
        for name in ("log_prob", "value", "advantage", "returns")
    }
    return Batch(
        pixels=jnp.zeros((B, 1, 1, 3), jnp.uint8), state=None,
        unclipped_action=jnp.asarray(rng.normal(size=(B, 2)), jnp.float32),
        weight=jnp.asarray(weight, jnp.float32), **numbers,
    )  # fmt: skip


def policy(seed: int = 1) -> Normal:
    mean = jax.random.normal(jax.random.key(seed), (B, 2))
    return Normal(mean, jnp.full((B, 2), 0.8), False)


def test_the_policy_loss_is_ppo_s():
    samples, now = batch(), policy()
    loss, facts = policy_loss(now, samples, CONFIG, KEY)
    kept = np.asarray(samples.weight) == 1
    ratio = np.exp(
        np.asarray(now.log_prob(samples.unclipped_action) - samples.log_prob, np.float64)
    )[kept]
    advantage = np.asarray(samples.advantage, np.float64)[kept]
    objective = np.minimum(ratio * advantage, np.clip(ratio, 0.8, 1.2) * advantage).mean()
    entropy = 2 * (np.log(0.8) + 0.5 * np.log(2 * np.pi * np.e))
    assert float(loss) == pytest.approx(-objective - 0.03 * entropy, rel=1e-5)
    assert float(facts["policy/entropy"]) == pytest.approx(entropy, rel=1e-5)
    assert float(facts["policy/approx_kl"]) == pytest.approx(
        (ratio - 1 - np.log(ratio)).mean(), rel=1e-4
    )
    assert float(facts["policy/clip_fraction"]) == pytest.approx((abs(ratio - 1) > 0.2).mean())


@pytest.mark.parametrize(
    ("ratio", "advantage", "goes_on"),
    [(1.5, 1.0, False), (1.5, -1.0, True), (0.5, 1.0, True), (0.5, -1.0, False), (1.1, 1.0, True)],
)
def test_the_gradient_stops_where_the_policy_has_moved_far_enough(ratio, advantage, goes_on):
    samples = batch()._replace(advantage=jnp.full(B, advantage))
    config = OnPolicyConfig(ent_coef=0.0, normalize_advantage="none")

    def loss(mean):
        now = policy().replace(mean=mean)
        old = jax.lax.stop_gradient(now.log_prob(samples.unclipped_action)) - np.log(ratio)
        return policy_loss(now, samples._replace(log_prob=old), config, KEY)[0]

    assert bool(jnp.any(jax.grad(loss)(policy().mean) != 0)) == goes_on


@pytest.mark.parametrize("normalize_advantage", ["none", "minibatch"])
def test_samples_without_weight_teach_nothing(normalize_advantage):
    config = OnPolicyConfig(normalize_advantage=normalize_advantage)

    @partial(jax.grad, argnums=(0, 1))
    def gradients(mean, value, samples):
        now = policy().replace(mean=mean)
        return (
            policy_loss(now, samples, config, KEY)[0]
            + value_loss(value, samples.returns, samples.weight)
            + clipped_value_loss(value, samples, 0.2)
        )

    samples, other = batch(), batch(5)
    masked = np.asarray(samples.weight) == 0
    given = policy().mean, jax.random.normal(jax.random.key(2), (B,))
    expected = gradients(*given, samples)
    for gradient in expected:
        assert (np.asarray(gradient)[masked] == 0).all()
        assert (np.asarray(gradient)[~masked] != 0).any()
    # Nor do they change what the others teach.
    changed = {
        name: jnp.where(masked.reshape(-1, *(1,) * (new.ndim - 1)), 100 * new, old)
        for (name, old), new in zip(samples._asdict().items(), other, strict=True)
        if name not in ("pixels", "state", "weight")
    }
    for one, two in zip(expected, gradients(*given, samples._replace(**changed)), strict=True):
        np.testing.assert_array_equal(one, two)
    # A batch in which nothing counts has no gradient.
    for gradient in gradients(*given, samples._replace(weight=jnp.zeros(B))):
        np.testing.assert_array_equal(gradient, 0)


def test_normalized_numbers_have_mean_0_and_deviation_1_where_they_count():
    samples = batch()
    kept = np.asarray(samples.weight) == 1
    result = np.asarray(normalized(5 + 3 * samples.returns, samples.weight))[kept]
    assert result.mean() == pytest.approx(0, abs=1e-6)
    assert result.std() == pytest.approx(1, rel=1e-5)


@pytest.mark.parametrize(
    # The value was 0 and the return is 1; the loss is half the larger of two squares.
    ("value", "loss", "slope"),
    [(0.1, 0.9**2 / 2, -0.9), (0.5, 0.8**2 / 2, 0.0), (-0.5, 1.5**2 / 2, -1.5)],
)
def test_a_clipped_value_gains_nothing_beyond_the_bound(value, loss, slope):
    sample = batch()._replace(value=jnp.zeros(1), returns=jnp.ones(1), weight=jnp.ones(1))
    actual, gradient = jax.value_and_grad(
        lambda value: clipped_value_loss(jnp.array([value]), sample, 0.2)
    )(value)
    assert float(actual) == pytest.approx(loss)
    assert float(gradient) == pytest.approx(slope)


@pytest.mark.parametrize("max_grad_norm", [0.0, 0.5])
def test_steps_are_those_of_adam_with_each_network_s_gradient_clipped(max_grad_norm):
    config = OnPolicyConfig(learning_rate=0.01, adam_eps=1e-5, max_grad_norm=max_grad_norm)
    optimizer = Optimizer(config)
    clip = optax.clip_by_global_norm(max_grad_norm) if max_grad_norm else optax.identity()
    reference = optax.chain(clip, optax.adam(0.01, eps=1e-5))
    networks = {name: {"w": jnp.ones(3), "b": jnp.zeros(2)} for name in ("one", "other")}
    opt_state = optimizer.init(networks)
    expected, theirs = dict(networks), {n: reference.init(p) for n, p in networks.items()}
    for t in range(5):
        # One gradient is far beyond the bound and one far below: they are clipped apart.
        gradients = {
            name: jax.tree.map(
                lambda p, t=t, scale=scale: scale * jnp.cos(t + jnp.arange(p.size)), networks[name]
            )
            for name, scale in (("one", 30.0), ("other", 1e-3))
        }
        networks, opt_state, norms = optimizer.step(networks, opt_state, gradients, jnp.uint32(t))
        for name, gradient in gradients.items():
            assert float(norms[name]) == pytest.approx(float(optax.tree.norm(gradient)))
            updates, theirs[name] = reference.update(gradient, theirs[name])
            expected[name] = optax.apply_updates(expected[name], updates)
            for a, b in zip(*map(jax.tree.leaves, (networks[name], expected[name])), strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7)


def test_networks_without_a_gradient_stay():
    optimizer = Optimizer(OnPolicyConfig())
    networks = {name: jnp.ones(3) for name in ("learns", "stays")}
    opt_state = optimizer.init(networks)
    for t in range(3):
        networks, opt_state, norms = optimizer.step(
            networks, opt_state, {"learns": jnp.ones(3)}, jnp.uint32(t)
        )
    assert set(norms) == {"learns"}
    assert int(opt_state["learns"].count) == 3
    assert int(opt_state["stays"].count) == 0
    np.testing.assert_array_equal(networks["stays"], 1.0)


def test_the_step_size_falls_along_a_line_to_0():
    config = OnPolicyConfig(anneal=True, learning_rate=0.1, total_steps=256 * 64 * 8)
    rate = Optimizer(config).learning_rate
    rates = [float(rate(jnp.uint32(i))) for i in range(10)]
    np.testing.assert_allclose(rates[:9], 0.1 * (1 - np.arange(9) / 8), atol=1e-8)
    assert rates[8] == rates[9] == 0.0
    constant = Optimizer(OnPolicyConfig(learning_rate=0.1)).learning_rate
    assert float(constant(jnp.uint32(2**31))) == pytest.approx(0.1)


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
