"""An algorithm without rollouts, values or log-probabilities trains, resumes and is evaluated."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.config import TrainConfig
from pixelbrax_jax.agents.optimizer import Optimizer
from pixelbrax_jax.agents.rollout import collect
from pixelbrax_jax.agents.runner.settings import RunConfig
from pixelbrax_jax.agents.runner.train import run
from pixelbrax_jax.agents.train_state import (
    ACTIONS,
    ENVS,
    TrainState,
    along_envs,
    stream_key,
    without_envs,
)
from tests.agents.small import PARAMS, SMALL, ball_envs, same

STEPS, SLOTS = 2, 8


class OwnState(TrainState):
    target: dict = without_envs()
    replay: jax.Array = along_envs(1, kept=False)


class OwnConfig(TrainConfig):
    @property
    def steps_per_iteration(self) -> int:
        return self.num_envs * STEPS


@dataclass(frozen=True)
class Own(Algorithm):
    """Pulls a constant action towards those in a replay buffer, each weighed by its reward."""

    name = "own"
    acting = ("policy",)

    def init(self, key, env_params):
        networks = {"policy": jnp.zeros(self.envs.env.action_size)}
        return OwnState(
            networks=networks,
            opt_state=Optimizer(self.config).init(networks),
            env_state=self.envs.reset(jax.random.fold_in(key, ENVS), env_params)[0],
            key=key,
            iteration=jnp.uint32(0),
            target=networks,
            replay=jnp.zeros((SLOTS, self.config.num_envs, 2)),
        )

    def act(self, networks, pixels, key=None):
        mean = jnp.broadcast_to(networks["policy"], (pixels.shape[0], self.envs.env.action_size))
        return mean if key is None else mean + jax.random.normal(key, mean.shape)

    def iterate(self, state, env_params):
        def choose(pixels, seen, key):
            action = self.act(state.networks, pixels, key)
            return action, action

        env_state, rollout = collect(
            self.envs, state.env_state, env_params, choose, stream_key(state, ACTIONS), STEPS
        )
        new = jnp.concatenate([rollout.choice, rollout.reward[..., None]], -1)
        replay = jnp.roll(state.replay, STEPS, 0).at[:STEPS].set(new)

        def loss(networks):
            return jnp.mean(replay[..., 1:] * (networks["policy"] - replay[..., :1]) ** 2)

        networks, opt_state, _ = Optimizer(self.config).step(
            state.networks, state.opt_state, jax.grad(loss)(state.networks), state.iteration
        )
        state = state.replace(
            networks=networks, opt_state=opt_state, env_state=env_state, target=state.networks,
            replay=replay, iteration=state.iteration + 1,
        )  # fmt: skip
        return state, rollout.episode_metrics()


@pytest.fixture(scope="module")
def own() -> Own:
    names = ("env", "encoder", "num_envs")
    config = OwnConfig(**{name: SMALL[name] for name in names}, total_steps=3 * 4 * STEPS)
    return Own(config, ball_envs())


def test_it_trains_resumes_and_is_evaluated(own, tmp_path):
    options = RunConfig(str(tmp_path), num_evals=1, eval_episodes=2, progress=False)
    splits = {"clean": (own.envs.env, PARAMS)}
    first = run(own, PARAMS, options, splits=splits)
    assert int(first.state.iteration) == 3
    assert np.isfinite(first.evaluations["clean"].mean)
    assert np.all(first.state.replay[: 3 * STEPS].any(-1))
    longer = Own(replace(own.config, total_steps=4 * 4 * STEPS), own.envs)
    resumed = run(longer, PARAMS, replace(options, resume="latest"), splits=splits).state
    assert int(resumed.iteration) == 4
    # The parts that are kept are those of the checkpoint; the buffer began anew.
    assert same(resumed.target, first.state.networks)
    assert np.all(resumed.replay[:STEPS].any(-1))
    assert not resumed.replay[STEPS:].any()


def test_settings_say_how_many_steps_an_iteration_has():
    with pytest.raises(NotImplementedError, match="TrainConfig lacks steps_per_iteration"):
        _ = TrainConfig().num_iterations
    with pytest.raises(NotImplementedError, match="own has no auxiliary phase"):
        Own(OwnConfig(env=SMALL["env"], encoder="small", num_envs=4), ball_envs()).auxiliary(None)
