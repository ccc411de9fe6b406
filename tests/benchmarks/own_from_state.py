"""What PPO of the preset `cpu` learns when it sees the state in place of pixels.

    python -m tests.benchmarks.own_from_state --task ant
    python -m tests.benchmarks.own_from_state --task ant --initial-std 0.5

Everything but the networks is as from pixels, so that it tells what settings are good for, and
what remains between its returns and those from pixels is seeing. Pictures are drawn as small as
may be, and nobody looks at them.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from pixelbrax_jax import VectorPixelEnv, compiler_options
from pixelbrax_jax.agents.algorithm import train_function
from pixelbrax_jax.agents.config import describe, make_env
from pixelbrax_jax.agents.networks.actor import LOG_STD_RANGE, SMALLEST
from pixelbrax_jax.agents.networks.distributions import Normal
from pixelbrax_jax.agents.on_policy.actor_critic import ActorCritic
from pixelbrax_jax.agents.on_policy.losses import Metrics
from pixelbrax_jax.agents.on_policy.ppo import PPO, PPOConfig
from pixelbrax_jax.agents.on_policy.presets import preset
from pixelbrax_jax.agents.optimizer import Networks
from tests.benchmarks.experiments import TASKS
from tests.benchmarks.results import FOLDER, task_key

OUTPUT = FOLDER / "own_from_state.json"


class StateActor(nn.Module):
    """A Gaussian policy; its layers are those of the critic that sees the state."""

    action_size: int
    initial_std: float

    @nn.compact
    def __call__(self, state: jax.Array) -> Normal:
        """Return the distribution over actions for (B, S) states."""
        init = nn.initializers.orthogonal
        features = jnp.tanh(nn.LayerNorm()(nn.Dense(256, kernel_init=init(2**0.5))(state)))
        features = nn.relu(nn.Dense(256, kernel_init=init(2**0.5))(features))
        mean = nn.Dense(self.action_size, kernel_init=init(0.01))(features)
        start = nn.initializers.constant(np.log(self.initial_std))
        log_std = self.param("log_std", start, (self.action_size,))
        return Normal(
            mean,
            jnp.broadcast_to(jnp.exp(jnp.clip(log_std, *LOG_STD_RANGE)), mean.shape),
            squash=False,
        )


@dataclass(frozen=True)
class StateActorCritic(ActorCritic):
    """Policy and value of the state; for training, whose `decide` asks for both."""

    @cached_property
    def _policy(self) -> StateActor:
        return StateActor(self.envs.env.action_size, self.config.initial_std)

    def init(self, key: jax.Array) -> Networks:
        """Sample initial parameters."""
        state = jnp.zeros((1, *self.envs.env.obs_spec["state"].shape))
        keys = jax.random.split(key)
        return {
            "actor": self._policy.init(keys[0], state),
            "critic": self._critic.init(keys[1], None, state),
        }

    def __call__(
        self, networks: Networks, pixels: jax.Array, state: jax.Array | None
    ) -> tuple[Normal, jax.Array]:
        """Return policy and value of (B, S) states."""
        policy: Normal = self._policy.apply(networks["actor"], state)  # type: ignore[assignment]
        return policy, self.critic(networks["critic"], pixels, state)


@dataclass(frozen=True)
class StatePPO(PPO):
    """PPO that sees the state."""

    @cached_property
    def agent(self) -> StateActorCritic:
        """Its networks."""
        return StateActorCritic(self.config, self.envs, shared=False)


def tenths(metrics: Metrics) -> list[float]:
    """Mean returns of the episodes that ended in each tenth of a run."""
    parts = zip(
        np.array_split(np.asarray(metrics["episode/return_sum"]), 10),
        np.array_split(np.asarray(metrics["episode/count"]), 10),
        strict=True,
    )
    return [round(float(total.sum() / count.sum()), 1) for total, count in parts]


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", choices=TASKS, default="ant")
    parser.add_argument("--initial-std", type=float, help="in place of the preset's")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    given = preset("ppo", "cpu", options.task)
    assert isinstance(given, PPOConfig)
    config = given.replace(
        initial_std=given.initial_std if options.initial_std is None else options.initial_std,
        encoder="small",
        height=SMALLEST["small"],
        width=SMALLEST["small"],
        layout="separate",
        state_critic=True,
    )
    env, env_params = make_env(config)
    algorithm = StatePPO(config, VectorPixelEnv(env, config.num_envs))
    train = jax.jit(train_function(algorithm, env_params), compiler_options=compiler_options(env))
    began = time.monotonic()
    _, metrics = jax.block_until_ready(train(jax.random.key(options.seed)))
    found = {
        "steps": config.steps_per_iteration * config.num_iterations,
        "seconds": round(time.monotonic() - began, 1),
        "return in each tenth": tenths(metrics),
        "last std": round(float(metrics["policy/std_mean"][-1]), 3),
    }
    name = f"{task_key(describe(config))} std {config.initial_std} seed {options.seed}"
    known = json.loads(OUTPUT.read_text()) if OUTPUT.exists() else {}
    OUTPUT.write_text(json.dumps(known | {name: found}, indent=1) + "\n")
    print(name, json.dumps(found))


if __name__ == "__main__":
    main()
