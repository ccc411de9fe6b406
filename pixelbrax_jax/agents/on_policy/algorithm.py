"""The base of on-policy algorithms: rollouts, and updates in minibatches."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.networks.actor_critic import Actor, ActorCritic, Critic
from pixelbrax_jax.agents.on_policy.config import OnPolicyConfig
from pixelbrax_jax.agents.on_policy.losses import Batch, RewardScaler, gae, mean, normalized
from pixelbrax_jax.agents.optimizer import Optimizer
from pixelbrax_jax.agents.rollout import Rollout, at_times, collect, observations, split_obs
from pixelbrax_jax.agents.train_state import (
    ACTIONS,
    ENVS,
    NETWORKS,
    Metrics,
    Networks,
    TrainState,
    as_declared,
    stream_key,
    without_envs,
)
from pixelbrax_jax.flags import under_default_flags
from pixelbrax_jax.types import EnvParams

Loss = Callable[[Networks, Batch, jax.Array], tuple[jax.Array, Metrics]]
"""Maps networks, a batch and a key to the loss and scalars to log."""


class OnPolicyState(TrainState):
    """The state of a run; ``aux_opt_state`` and ``buffer`` are None without an auxiliary phase."""

    aux_opt_state: Networks | None = without_envs()
    scaler: RewardScaler = as_declared()
    buffer: Any = as_declared()


class Decision(NamedTuple):
    """An unclipped action, its log-probability and the value of its observation."""

    unclipped_action: jax.Array
    log_prob: jax.Array
    value: jax.Array


class Experience(NamedTuple):
    """A rollout with a ``Decision`` as ``choice``, and its (T, N) advantages and returns."""

    rollout: Rollout
    advantage: jax.Array
    returns: jax.Array


@dataclass(frozen=True)
class OnPolicy(Algorithm):
    """An algorithm that learns from rollouts of its current policy."""

    config: OnPolicyConfig

    @property
    @abstractmethod
    def agent(self) -> ActorCritic:
        """The networks."""

    @abstractmethod
    def learn(self, state: OnPolicyState, experience: Experience) -> tuple[OnPolicyState, Metrics]:
        """Learn from a rollout; ``state`` is the state after it."""

    def make_agent(self, *, shared: bool, has_value: bool, detach: bool = False) -> ActorCritic:
        """Make actor and critic; ``detach`` stops gradients of a shared value at the encoder."""
        config = self.config
        size = self.envs.env.action_size
        actor = Actor(config.encoder, size, config.policy, config.initial_std, has_value)
        critic = None if shared else Critic(config.encoder, sees_state=config.state_critic)
        return ActorCritic(actor, critic, detach)

    def init_networks(self, key: jax.Array) -> Networks:
        """Sample initial parameters by network name."""
        return self.agent.init(key, *split_obs(self.envs.env.obs_spec))

    @under_default_flags
    def init(self, key: jax.Array, env_params: EnvParams) -> OnPolicyState:
        """See ``Algorithm.init``."""
        networks = self.init_networks(jax.random.fold_in(key, NETWORKS))
        env_state, _ = self.envs.reset(jax.random.fold_in(key, ENVS), env_params)
        return OnPolicyState(
            networks=networks,
            opt_state=Optimizer(self.config).init(networks),
            env_state=env_state,
            key=key,
            iteration=jnp.uint32(0),
            aux_opt_state=None,
            scaler=RewardScaler.start(self.config.num_envs),
            buffer=None,
        )

    @under_default_flags
    def iterate(self, state: OnPolicyState, env_params: EnvParams) -> tuple[OnPolicyState, Metrics]:
        """Collect a rollout and learn from it."""
        state, experience, metrics = self.gather(state, env_params)
        state, learn_metrics = self.learn(state, experience)
        rate = Optimizer(self.config).learning_rate(state.iteration)
        state = state.replace(iteration=state.iteration + 1)
        return state, metrics | learn_metrics | {"learning_rate": rate}

    @under_default_flags
    def act(self, networks: Networks, pixels: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """See ``Algorithm.act``; without a key the actions are the mean actions."""
        policy = self.agent.actor(networks["actor"], pixels).policy
        return policy.action(policy.mean if key is None else policy.sample(key))

    def gather(
        self, state: OnPolicyState, env_params: EnvParams
    ) -> tuple[OnPolicyState, Experience, Metrics]:
        """Collect a rollout; return the state after it, the experience and its metrics."""
        config = self.config

        def choose(pixels: jax.Array, seen: jax.Array | None, key: jax.Array) -> Any:
            policy, value = self.agent(state.networks, pixels, seen)
            unclipped = policy.sample(key)
            decision = Decision(unclipped, policy.log_prob(unclipped), value)
            return policy.action(unclipped), decision

        key, sizes = stream_key(state, ACTIONS), (config.num_steps, config.random_shift)
        env_state, rollout = collect(self.envs, state.env_state, env_params, choose, key, *sizes)
        scaler, reward = state.scaler, rollout.reward
        if config.normalize_reward:
            scaler, reward = scaler(reward, rollout.done, rollout.valid, config.gamma)
        values = rollout.choice.value, rollout.last_choice.value
        ends = rollout.terminated, rollout.truncated
        advantage, returns = gae(reward, *values, *ends, config.gamma, config.gae_lambda)
        weight = rollout.valid.astype(jnp.float32)
        metrics = rollout.episode_metrics() | _metrics(rollout.choice, advantage, returns, weight)
        metrics["reward/scale"] = scaler.scale if config.normalize_reward else jnp.float32(1.0)
        if config.normalize_advantage == "batch":
            advantage = normalized(advantage, weight)
        state = state.replace(env_state=env_state, scaler=scaler)
        return state, Experience(rollout, advantage, returns), metrics

    def batch_at(self, experience: Experience, times: jax.Array) -> Batch:
        """Return the samples at (B, N) int32 times."""
        rollout, advantage, returns = experience
        pixels = observations(rollout.frames, times, self.config.random_shift)
        rows = (rollout.frames.state, *rollout.choice, advantage, returns, rollout.valid)
        *samples, valid = jax.tree.map(lambda rows: at_times(rows, times), rows)
        return Batch._make((pixels, *samples, valid.astype(jnp.float32)))

    def update(
        self,
        state: OnPolicyState,
        loss: Loss,
        experience: Experience,
        num_epochs: int,
        key: jax.Array,
        *,
        learners: Collection[str] | None = None,
        target_kl: float | None = None,
    ) -> tuple[OnPolicyState, Metrics]:
        """Take an optimiser step for each minibatch of a rollout, ``num_epochs`` times.

        Only ``learners`` learn; None means all networks with an optimiser state. The update stops
        above the approximate KL divergence ``target_kl``. Metrics are means over used minibatches.
        """
        config, optimizer = self.config, Optimizer(self.config)

        def step(
            carry: tuple[Networks, Networks, jax.Array], inputs: tuple[jax.Array, jax.Array]
        ) -> tuple[Any, tuple[Metrics, jax.Array]]:
            networks, opt_state, stopped = carry
            times, key = inputs
            batch = self.batch_at(experience, times)
            gradients, metrics = jax.grad(loss, has_aux=True)(networks, batch, key)
            # Adam's momentum moves parameters even at a gradient of 0, so the others get none.
            gradients = {name: gradients[name] for name in opt_state}
            old = networks, opt_state
            *new, norms = optimizer.step(networks, opt_state, gradients, state.iteration)
            metrics |= {f"grad_norm/{name}": norm for name, norm in norms.items()}
            if target_kl is None:
                return (*new, stopped), (metrics, jnp.float32(1.0))
            # This minibatch still counts, because its divergence is known only after the step.
            used = jnp.where(stopped, 0.0, 1.0)
            keep = jax.tree.map(lambda old, new: jnp.where(stopped, old, new), old, tuple(new))
            return (*keep, stopped | (metrics["policy/approx_kl"] > target_kl)), (metrics, used)

        networks = {name: state.networks[name] for name in state.opt_state}
        opt_state = {name: state.opt_state[name] for name in learners or state.opt_state}
        carry = (networks, opt_state, jnp.bool_(False))
        (networks, opt_state, _), (metrics, used) = passes(
            step, carry, key, num_epochs, config.num_steps, config.num_envs, config.num_minibatches
        )
        metrics = {name: jnp.sum(x * used) / jnp.sum(used) for name, x in metrics.items()}
        opt_state = state.opt_state | opt_state
        return state.replace(networks=state.networks | networks, opt_state=opt_state), metrics


def passes(
    step: Callable[[Any, tuple[jax.Array, jax.Array]], tuple[Any, Any]],
    carry: Any,
    key: jax.Array,
    num_epochs: int,
    num_steps: int,
    num_envs: int,
    parts: int,
) -> tuple[Any, Any]:
    """Scan ``step(carry, (times, key))`` over the minibatches of several epochs."""

    def epoch(carry: Any, key: jax.Array) -> tuple[Any, Any]:
        order = minibatch_times(jax.random.fold_in(key, 0), num_steps, num_envs, parts)
        keys = jax.random.split(jax.random.fold_in(key, 1), parts)
        return jax.lax.scan(step, carry, (order, keys))

    return jax.lax.scan(epoch, carry, jax.random.split(key, num_epochs))


def minibatch_times(key: jax.Array, num_steps: int, num_envs: int, parts: int) -> jax.Array:
    """Sample a partition of T steps into M minibatches by environment, (M, T / M, N) int32."""
    # A minibatch has equally many steps of each environment, so devices share it equally.
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.arange(num_envs))
    order = jax.vmap(lambda key: jax.random.permutation(key, num_steps), out_axes=1)(keys)
    return order.reshape(parts, num_steps // parts, num_envs)


def _metrics(
    decision: Decision, advantage: jax.Array, returns: jax.Array, weight: jax.Array
) -> Metrics:
    center = returns - mean(returns, weight)
    unexplained = returns - decision.value
    unexplained -= mean(unexplained, weight)
    variance = mean(center**2, weight)
    saturated = jnp.mean(jnp.abs(decision.unclipped_action) >= 1.0, -1)
    spread = advantage - mean(advantage, weight)
    return {
        "advantage/mean": mean(advantage, weight),
        "advantage/std": jnp.sqrt(mean(spread**2, weight)),
        "return/mean": mean(returns, weight),
        "return/std": jnp.sqrt(variance),
        "value/explained_variance": 1.0 - mean(unexplained**2, weight) / (variance + 1e-8),
        "policy/saturation": mean(saturated, weight),
    }
