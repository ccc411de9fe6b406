"""When evaluations are due, where the environments are in a training state, and equal runs."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest
from flax import struct

from pixelbrax_jax import PixelEnv, VectorPixelEnv
from pixelbrax_jax.agents.on_policy.dcpg import DCPG, DCPGConfig
from pixelbrax_jax.agents.on_policy.ppg import PPG, PPGConfig
from pixelbrax_jax.agents.on_policy.ppo import PPO, PPOConfig
from pixelbrax_jax.agents.runner.evaluate import Evaluator
from pixelbrax_jax.agents.runner.programs import Runs
from pixelbrax_jax.agents.runner.train import is_due
from pixelbrax_jax.agents.train_state import along_envs, as_declared, env_axes, without_envs
from tests.agents.small import OPTIONS, PARAMS, PHASIC, SMALL, ball_envs
from tests.compilations import counted
from tests.envs.toy import Ball, limited

ENVS = ball_envs()
SEVEN = VectorPixelEnv(ENVS.env, 7)


@pytest.mark.parametrize(
    ("times", "total", "expected"),
    [(2, 10, [5, 10]), (3, 10, [4, 7, 10]), (0, 10, []), (7, 3, [1, 2, 3])],
)
def test_evaluations_are_spread_evenly(times, total, expected):
    assert [n for n in range(1, total + 1) if is_due(n, times, total)] == expected


@pytest.mark.parametrize(
    "algorithm",
    [
        PPO(PPOConfig(**SMALL), ENVS),
        PPG(PPGConfig(**SMALL, **PHASIC), ENVS),
        DCPG(DCPGConfig(**SMALL, **PHASIC, decoupled=True), ENVS),
    ],
    ids=lambda algorithm: algorithm.name,
)
def test_environments_are_where_the_fields_say(algorithm):
    """An axis that is declared has the number of environments, and no other axis has."""
    few, more = (
        jax.eval_shape(Runs(kind).init, 0, PARAMS)
        for kind in (algorithm, type(algorithm)(replace(algorithm.config, num_envs=7), SEVEN))
    )
    axes = env_axes(few)
    assert jax.tree.structure(axes) == jax.tree.structure(few)
    for axis, a, b in zip(*map(jax.tree.leaves, (axes, few, more)), strict=True):
        expected = list(a.shape)
        if axis >= 0:
            assert a.shape[axis] == SMALL["num_envs"]
            expected[axis] = 7
        assert tuple(expected) == b.shape


def test_a_field_that_declares_nothing_is_an_error():
    class State(struct.PyTreeNode):
        rewards: jax.Array = along_envs(1)
        network: jax.Array = without_envs()

    class Forgetful(struct.PyTreeNode):
        state: State = as_declared(leading_axes=2)
        new: jax.Array | None = None

    state = State(jnp.zeros((3, 4)), jnp.zeros(5))
    assert env_axes(state) == State(1, -1)
    with pytest.raises(TypeError, match=r"Forgetful\.new does not declare its environment axis"):
        env_axes(Forgetful(state, jnp.zeros(2)))


class Heavy(Ball):
    """Other physics, so other environments."""


def make_ppo(**changes):
    envs = VectorPixelEnv(PixelEnv(ENVS.env.physics, **OPTIONS), SMALL["num_envs"])
    return PPO(PPOConfig(**SMALL | changes), envs)


def test_equal_settings_are_equal_algorithms():
    one, two = make_ppo(), make_ppo()
    assert one == two
    assert hash(one) == hash(two)
    assert one != make_ppo(gamma=0.5)
    assert one != PPG(PPGConfig(**SMALL, **PHASIC), ENVS)
    assert one != PPO(PPOConfig(**SMALL), VectorPixelEnv(PixelEnv(Heavy(), **OPTIONS), 4))


def test_a_run_like_one_before_compiles_nothing():
    def train(seed, params):
        algorithm = make_ppo()
        runs = Runs(algorithm)
        state, _ = runs.iterate(runs.init(jnp.uint32(seed), params), params)
        env = PixelEnv(ENVS.env.physics, **OPTIONS)
        return Evaluator(algorithm, env, params, num_episodes=2)(state.networks)

    train(0, PARAMS)
    with counted() as events:
        train(1, limited(3))
    assert not events
