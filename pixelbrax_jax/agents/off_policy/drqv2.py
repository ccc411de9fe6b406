"""DrQ-v2 (Yarats et al., arXiv 2107.09645) in many environments, optionally with C51."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn

from pixelbrax_jax._platform.batches import one_run_after_the_other
from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.config import TrainConfig
from pixelbrax_jax.agents.networks.encoders import LAYERS, Convolutions
from pixelbrax_jax.agents.networks.q_functions import DeterministicActor, TwinQ
from pixelbrax_jax.agents.off_policy.config import DrQv2Config
from pixelbrax_jax.agents.off_policy.replay import Batch, Replay
from pixelbrax_jax.agents.optimizer import Optimizer
from pixelbrax_jax.agents.rollout import collect, shifted, split_obs
from pixelbrax_jax.agents.train_state import (
    ACTIONS,
    ENVS,
    NETWORKS,
    UPDATES,
    Metrics,
    Networks,
    TrainState,
    as_declared,
    stream_key,
    without_envs,
)
from pixelbrax_jax.flags import under_default_flags
from pixelbrax_jax.types import EnvParams

_LARGEST_ACTION = 1.0 - 1e-6
"""Bound of the actions in updates, at which ``tanh`` has a gradient."""


class OffPolicyState(TrainState):
    """The state of a run, with the averaged critic ``target``; checkpoints skip the replay."""

    target: Any = without_envs()
    replay: Replay = as_declared(kept=False)


class WithReplay(OffPolicyState):
    """The same state, with the replay in checkpoints."""

    replay: Replay = as_declared()


@dataclass(frozen=True)
class DrQv2(Algorithm):
    """DrQ-v2: a deterministic actor and two Q functions that learn from a replay."""

    config: DrQv2Config
    name: ClassVar[str] = "drqv2"
    config_class: ClassVar[type[TrainConfig]] = DrQv2Config
    acting: ClassVar[tuple[str, ...]] = ("encoder", "actor")
    # The replay is too large to be copied.
    vmaps_runs: ClassVar[bool] = True

    @cached_property
    def modules(self) -> dict[str, nn.Module]:
        """The networks."""
        config = self.config
        sizes = config.feature_dim, config.hidden_dim, config.layer_norm
        outputs = config.num_atoms if config.critic == "c51" else 1
        return {
            "encoder": Convolutions(LAYERS[config.encoder]),
            "actor": DeterministicActor(self.envs.env.action_size, *sizes),
            "critic": TwinQ(outputs, *sizes),
        }

    @under_default_flags
    def init(self, key: jax.Array, env_params: EnvParams) -> OffPolicyState:
        """See ``Algorithm.init``; the replay is empty."""
        config, env = self.config, self.envs.env
        spec, _ = split_obs(env.obs_spec)
        frame = jax.ShapeDtypeStruct((*spec.shape[:-1], config.frame_channels), spec.dtype)
        networks_key = jax.random.fold_in(key, NETWORKS)
        keys = {name: jax.random.fold_in(networks_key, i) for i, name in enumerate(self.modules)}
        pixels = jnp.zeros((1, *spec.shape), spec.dtype)
        features, encoder = self.modules["encoder"].init_with_output(keys["encoder"], pixels)
        action, actor = self.modules["actor"].init_with_output(keys["actor"], features)
        critic = self.modules["critic"].init(keys["critic"], features, action)
        networks = {"encoder": encoder, "actor": actor, "critic": critic}
        env_state, _ = self.envs.reset(jax.random.fold_in(key, ENVS), env_params)
        kind = WithReplay if config.checkpoint_replay else OffPolicyState
        return kind(
            networks=networks,
            opt_state=Optimizer(config).init(networks),
            env_state=env_state,
            key=key,
            iteration=jnp.uint32(0),
            target=critic,
            replay=Replay.empty(config.num_envs, config.slots, frame, env.action_size),
        )

    @under_default_flags
    def iterate(self, state: OffPolicyState, env_params: EnvParams) -> tuple[TrainState, Metrics]:
        """Collect steps into the replay and, once it holds enough, learn from it."""
        config = self.config
        # Steps of all environments, capped at the end of all schedules to fit into 32 bits.
        per_iteration = config.num_envs * config.num_steps
        enough = -(-max(config.std_steps, config.learning_starts) // per_iteration)
        steps = jnp.minimum(state.iteration, jnp.uint32(enough)) * jnp.uint32(per_iteration)
        schedule = optax.linear_schedule(config.initial_std, config.final_std, config.std_steps)
        std = jnp.float32(schedule(steps))

        act = one_run_after_the_other(self.act)

        def choose(
            pixels: jax.Array, seen: jax.Array | None, key: jax.Array
        ) -> tuple[jax.Array, jax.Array]:
            del seen
            noise_key, uniform_key = jax.random.split(key)
            action = noisy(act(state.networks, pixels), std, noise_key)
            uniform = jax.random.uniform(uniform_key, action.shape, minval=-1.0)
            action = jnp.where(steps < config.learning_starts, uniform, action)
            return action, action

        key = stream_key(state, ACTIONS)
        env_state, rollout = collect(
            self.envs, state.env_state, env_params, choose, key, config.num_steps
        )
        state = state.replace(env_state=env_state, replay=state.replay.add(rollout))
        state, metrics = self._learn(state, std)
        metrics |= rollout.episode_metrics() | {
            "policy/std": std,
            "replay/size": state.replay.size,
            "learning_rate": Optimizer(config).learning_rate(state.iteration),
        }
        return state.replace(iteration=state.iteration + 1), metrics

    @under_default_flags
    def act(self, networks: Networks, pixels: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """See ``Algorithm.act``; sampled actions have the noise at the end of the schedule."""
        features = self._apply("encoder", networks, pixels)
        action = jnp.tanh(self._apply("actor", networks, features))
        return action if key is None else noisy(action, self.config.final_std, key)

    def warnings(self, record: Mapping[str, float]) -> list[str]:
        """See ``Algorithm.warnings``."""
        config = self.config
        if config.critic != "c51" or not record.get("updates"):
            return []
        low, high = record["q/target_min"], record["q/target_max"]
        if config.v_min <= low and high <= config.v_max:
            return []
        return [
            f"returns from {low:.4g} to {high:.4g} leave the range of c51, v_min={config.v_min:g} "
            f"to v_max={config.v_max:g}, and are clipped; widen it"
        ]

    def _apply(self, name: str, networks: Networks, *inputs: jax.Array) -> jax.Array:
        """Apply a network, in bfloat16 if configured; the result is float32."""
        params = networks[name]
        if self.config.bfloat16:
            params = jax.tree.map(lambda x: x.astype(jnp.bfloat16), params)
            # The encoder scales pixels itself.
            if name != "encoder":
                inputs = tuple(x.astype(jnp.bfloat16) for x in inputs)
        output: Any = self.modules[name].apply(params, *inputs)
        return output.astype(jnp.float32)

    def _learn(self, state: OffPolicyState, std: jax.Array) -> tuple[OffPolicyState, Metrics]:
        """Make the updates of an iteration, or none while the replay holds too little."""
        config, replay, most = self.config, state.replay, self.config.random_shift
        keys = jax.random.split(stream_key(state, UPDATES), config.num_updates)
        start = (state.networks, state.opt_state, state.target)
        update = one_run_after_the_other(self._update)

        # The loop does not carry the replay, because XLA would copy it in every iteration.
        def step(carry: Any, inputs: tuple[jax.Array, jax.Array]) -> tuple[Any, Metrics]:
            number, key = inputs
            sample_key, shift_key, update_key = jax.random.split(key, 3)
            batch = replay.sample(
                sample_key, config.batch_size, config.env.frame_stack, config.n_step, config.gamma
            )
            shape = (2, config.batch_size, 2)
            now, later = jax.random.randint(shift_key, shape, -most, most + 1)
            batch = batch._replace(
                pixels=shifted(batch.pixels, now, most),
                next_pixels=shifted(batch.next_pixels, later, most),
            )
            return update(carry, batch, std, update_key, state.iteration, number)

        def learn() -> tuple[Any, Metrics]:
            carry, metrics = jax.lax.scan(step, start, (jnp.arange(config.num_updates), keys))
            extremes = {"q/target_min": jnp.min, "q/target_max": jnp.max}
            return carry, {k: extremes.get(k, jnp.mean)(v) for k, v in metrics.items()}

        def wait() -> tuple[Any, Metrics]:
            shapes = jax.eval_shape(learn)[1]
            return start, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

        learns = replay.size >= config.learning_starts
        (networks, opt_state, target), metrics = jax.lax.cond(learns, learn, wait)
        metrics["updates"] = jnp.where(learns, config.num_updates, 0)
        return state.replace(networks=networks, opt_state=opt_state, target=target), metrics

    def _update(
        self,
        carry: tuple[Networks, Networks, Any],
        batch: Batch,
        std: jax.Array,
        key: jax.Array,
        iteration: jax.Array,
        number: jax.Array,
    ) -> tuple[Any, Metrics]:
        """Update encoder and critic, the actor every ``policy_delay``-th time, and the target."""
        networks, opt_state, target = carry
        config, optimizer = self.config, Optimizer(self.config)
        target_key, actor_key = jax.random.split(key)

        critic_loss = jax.grad(self.critic_loss, has_aux=True)
        learners = {name: networks[name] for name in ("encoder", "critic")}
        gradients, (features, metrics) = critic_loss(
            learners, networks, target, batch, std, target_key
        )
        networks, opt_state, norms = optimizer.step(networks, opt_state, gradients, iteration)

        def improve(networks: Networks, opt_state: Networks) -> Any:
            gradient, loss = jax.grad(self.actor_loss, has_aux=True)(
                networks["actor"], networks, features, batch, std, actor_key
            )
            *new, norm = optimizer.step(networks, opt_state, {"actor": gradient}, iteration)
            return (*new, loss, norm["actor"])

        if config.policy_delay == 1:
            networks, opt_state, loss, norm = improve(networks, opt_state)
        else:
            count = iteration * jnp.uint32(config.num_updates) + number.astype(jnp.uint32)
            networks, opt_state, loss, norm = jax.lax.cond(
                count % config.policy_delay == 0,
                improve,
                lambda networks, opt_state: (networks, opt_state, jnp.float32(0), jnp.float32(0)),
                networks,
                opt_state,
            )
            # Turns means over all updates into means over those of the actor.
            loss, norm = loss * config.policy_delay, norm * config.policy_delay
        norms["actor"] = norm
        metrics |= {"loss/actor": loss}
        metrics |= {f"grad_norm/{name}": norm for name, norm in norms.items()}
        target = optax.incremental_update(networks["critic"], target, config.tau)
        return (networks, opt_state, target), metrics

    def critic_loss(
        self,
        learners: Networks,
        networks: Networks,
        target: Any,
        batch: Batch,
        std: jax.Array,
        key: jax.Array,
    ) -> tuple[jax.Array, tuple[jax.Array, Metrics]]:
        """Return the loss of encoder and critic, the (B, F) features, and scalars to log."""
        features = self._apply("encoder", learners, batch.pixels)
        # The encoder has no target: the online one encodes both observations.
        later = self._apply("encoder", networks, batch.next_pixels)
        mean_action = jnp.tanh(self._apply("actor", networks, later))
        action = noisy(mean_action, std, key, self.config.std_clip)
        outputs = self._apply("critic", learners, features, batch.action)
        next_outputs = self._apply("critic", {"critic": target}, later, action)
        error, goal = self._error(outputs, next_outputs, batch)
        loss = batch.mean(error)
        metrics = {
            "loss/critic": loss,
            "q/mean": batch.mean(self.values(outputs).mean(0)),
            "q/target_mean": batch.mean(goal.mean(0)),
            "q/target_min": goal.min(),
            "q/target_max": goal.max(),
        }
        return loss, (jax.lax.stop_gradient(features), metrics)

    def actor_loss(
        self,
        actor: Any,
        networks: Networks,
        features: jax.Array,
        batch: Batch,
        std: jax.Array,
        key: jax.Array,
    ) -> tuple[jax.Array, jax.Array]:
        """Return the loss of the actor, and the negative value of its noisy action."""
        output = self._apply("actor", {"actor": actor}, features)
        action = noisy(jnp.tanh(output), std, key, self.config.std_clip)
        values = self.values(self._apply("critic", networks, features, action))
        # The gradient of `min` is NaN if XLA rounds copies of values and result differently.
        least = jnp.where(values[0] < values[1], values[0], values[1])
        value = least if self.config.critic == "clipped" else values.mean(0)
        loss = -batch.mean(value)
        return loss + self.config.saturation_coef * jnp.mean(output**2), loss

    def values(self, outputs: jax.Array) -> jax.Array:
        """Map (2, B, outputs) of the critic to (2, B) values."""
        if self.config.critic == "clipped":
            return outputs[..., 0]
        return jnp.sum(jax.nn.softmax(outputs) * self._atoms, -1)

    def _error(
        self, outputs: jax.Array, next_outputs: jax.Array, batch: Batch
    ) -> tuple[jax.Array, jax.Array]:
        """Return the (B,) errors summed over both Q functions, and their targets (2 or 1, B)."""
        values = self.values(next_outputs)
        if self.config.critic == "clipped":
            goal = batch.reward + batch.discount * values.min(0)
            return jnp.sum((self.values(outputs) - goal) ** 2, 0), goal[None]
        moved = batch.reward[:, None] + batch.discount[:, None] * self._atoms
        goal = projected(jax.nn.softmax(next_outputs), moved, self._atoms)
        entropy = -jnp.sum(goal * jax.nn.log_softmax(outputs), -1)
        return jnp.sum(entropy, 0), batch.reward + batch.discount * values

    @property
    def _atoms(self) -> jax.Array:
        config = self.config
        return jnp.linspace(config.v_min, config.v_max, config.num_atoms, dtype=jnp.float32)


def noisy(action: jax.Array, std: Any, key: jax.Array, clip: float | None = None) -> jax.Array:
    """Add normal noise, within +- ``clip``, to (B, A) actions, and clip the result to [-1, 1].

    The gradient passes the bounds (the truncated normal of DrQ-v2's code, arXiv 2107.09645).
    """
    noise = std * jax.random.normal(key, action.shape)
    if clip is not None:
        noise = jnp.clip(noise, -clip, clip)
    noised = action + noise
    bounded = jnp.clip(noised, -_LARGEST_ACTION, _LARGEST_ACTION)
    return noised + jax.lax.stop_gradient(bounded - noised)


def projected(probabilities: jax.Array, values: jax.Array, support: jax.Array) -> jax.Array:
    """Project (..., M) probabilities onto (M,) atoms (C51; Bellemare et al., arXiv 1707.06887).

    The atoms are equally spaced. Each of (..., M) values, clipped to their range, splits its
    probability between the two nearest atoms so that the mean stays.
    """
    spacing = support[1] - support[0]
    values = jnp.clip(values, support[0], support[-1])
    distance = jnp.abs(values[..., None] - support) / spacing
    share = jnp.clip(1.0 - distance, 0.0, 1.0)
    return jnp.sum(probabilities[..., None] * share, -2)
