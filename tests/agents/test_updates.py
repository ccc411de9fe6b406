"""Whole updates of PPO and PPG's policy phase, and whole runs."""

from __future__ import annotations

import os
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax.agents.algorithm import train_function
from pixelbrax_jax.agents.on_policy.losses import value_loss
from pixelbrax_jax.agents.on_policy.ppg import PPG
from pixelbrax_jax.agents.on_policy.ppo import PPO
from tests.agents.small import AGENTS, PARAMS, PHASIC, assert_close, same, small_agent

ITERATIONS = 3
"""Of a run: an auxiliary phase comes after the second one."""


PPO_AGENT, PPG_AGENT = AGENTS["ppo"], AGENTS["ppg"]


@pytest.fixture(params=AGENTS)
def agent(request):
    return AGENTS[request.param]


def test_the_same_key_gives_the_same_run_and_another_another(agent):
    first, facts = agent.run(agent.init(), ITERATIONS)
    again = agent.algorithm.init(jax.random.key(0), PARAMS)
    second, more_facts = agent.run(again, ITERATIONS)
    assert same(first, second)
    assert same(facts, more_facts)
    other, _ = agent.run(agent.init(1), ITERATIONS)
    assert not same(first.networks, other.networks)
    assert int(first.iteration) == ITERATIONS


def test_every_iteration_draws_anew(agent):
    # The same state of everything but the number of the iteration.
    state = agent.init()
    first, _ = agent.iterate(state)
    later, _ = agent.iterate(state.replace(iteration=jnp.uint32(2)))
    assert not same(first.env_state.sim.physics.engine, later.env_state.sim.physics.engine)


def test_minibatches_find_the_policy_and_value_that_played(agent):
    """What is put together again for the update is what the agent saw, so the ratio is 1."""
    state = agent.without_steps(agent.run(agent.init(), ITERATIONS)[0])
    after, facts = agent.iterate(state)
    # With a step size of 0 every minibatch is a first one.
    assert same(after.networks, state.networks)
    assert float(facts["learning_rate"]) == 0.0
    assert float(facts["policy/clip_fraction"]) == 0.0
    # Other shapes of a batch may round in another way.
    assert abs(float(facts["policy/approx_kl"])) < 1e-6
    if "loss/value_distill" in facts and "target" not in state.networks:
        assert float(facts["loss/value_distill"]) < 1e-10


def test_ppg_without_auxiliary_phases_is_ppo():
    assert small_agent(PPG, aux_epochs=0).algorithm.auxiliary_every == 0

    def shared(networks):
        """All but the value head, which PPO's actor does not have."""
        return {
            "actor": {k: v for k, v in networks["actor"]["params"].items() if k != "value"},
            "critic": networks["critic"],
        }

    # Compiled without optimisation, XLA rounds convolutions in these two programs differently.
    optimized = os.environ.get("PIXELBRAX_TESTS_OPTIMIZE") == "1"
    tolerance = {"rtol": 0.0} if optimized else {"rtol": 1e-5, "atol": 1e-7}
    agree = partial(assert_close, **tolerance)
    one, other = PPO_AGENT.init(), PPG_AGENT.init()
    assert same(shared(one.networks), shared(other.networks))
    for _ in range(ITERATIONS):
        one, facts = PPO_AGENT.iterate(one)
        other, more_facts = PPG_AGENT.iterate(other)
        agree(shared(one.networks), shared(other.networks))
        agree(facts, more_facts)
    agree(one.env_state, other.env_state)
    agree(one.scaler, other.scaler)


def test_ppg_s_actor_keeps_its_value_head_until_the_auxiliary_phase():
    state = PPG_AGENT.init()
    head = state.networks["actor"]["params"]["value"]
    for _ in range(2):
        state, _ = PPG_AGENT.iterate(state)
        assert same(state.networks["actor"]["params"]["value"], head)
    state, _ = PPG_AGENT.auxiliary(state)
    learned = state.networks["actor"]["params"]["value"]
    assert not same(learned, head)
    # The policy's Adam has never had a gradient of that head, and does not move it now.
    state, _ = PPG_AGENT.iterate(state)
    assert same(state.networks["actor"]["params"]["value"], learned)


@pytest.mark.slow
def test_ppg_s_passes_of_the_value_alone_leave_the_policy_alone():
    longer = small_agent(PPG, value_epochs=3)
    state = PPG_AGENT.init()
    # Adam's moments are not 0 then, so that it would move what has a gradient of 0.
    state, _ = PPG_AGENT.iterate(state)
    one, _ = PPG_AGENT.iterate(state)
    three, _ = longer.iterate(state)
    assert_close(one.networks["actor"], three.networks["actor"], rtol=1e-4, atol=1e-6)
    assert_close(one.opt_state["actor"], three.opt_state["actor"], rtol=1e-3, atol=1e-6)
    counts = {name: int(three.opt_state[name].count) for name in ("actor", "critic")}
    # One iteration of one pass, and one of one and of three.
    assert counts == {"actor": 2 + 2, "critic": 2 + 6}


def test_an_update_stops_once_the_policy_has_moved_too_far():
    agent = small_agent(PPO, learning_rate=0.03, update_epochs=3, target_kl=1e-4)
    state, facts = agent.iterate(agent.init())
    # The first of 6 minibatches sees the policy that played; the second one sees that it has
    # moved, and is the last one that is used.
    assert {int(moments.count) for moments in state.opt_state.values()} == {2}
    assert float(facts["policy/approx_kl"]) > 1e-4 / 2
    # A policy that does not move never stops.
    still, facts = agent.iterate(agent.without_steps(state))
    assert {int(moments.count) for moments in still.opt_state.values()} == {2 + 6}


def moved_by_value(layout: str) -> set[str]:
    """Which layers of which networks a value loss moves, with a layout of PPG."""
    algorithm = small_agent(PPG, layout=layout).algorithm
    pixels = jax.random.randint(jax.random.key(0), (6, 18, 18, 6), 0, 256).astype(jnp.uint8)

    @jax.jit
    @jax.grad
    def gradient(networks):
        _, value = algorithm.agent(networks, pixels, None)
        return value_loss(value, jnp.ones(6), jnp.ones(6))

    return {
        f"{name} {layer}"
        for name, params in gradient(algorithm.init_networks(jax.random.key(0))).items()
        for layer, slopes in params["params"].items()
        if any(bool(jnp.any(x != 0)) for x in jax.tree.leaves(slopes))
    }


@pytest.mark.parametrize(
    ("layout", "moved"),
    [
        ("dual", {"critic Small_0", "critic value"}),
        ("detach", {"actor value"}),
        ("shared", {"actor Small_0", "actor value"}),
    ],
)
def test_a_value_moves_what_the_layout_lets_it(layout, moved):
    assert moved_by_value(layout) == moved


@pytest.mark.slow
def test_a_run_is_its_iterations_and_runs_may_be_mapped_over_keys():
    keys = jax.vmap(jax.random.key)(jnp.arange(2))
    train = train_function(PPG_AGENT.algorithm, PARAMS)
    states, metrics = jax.jit(jax.vmap(train))(keys)
    number = PPG_AGENT.config.num_iterations
    assert number % PHASIC["num_policy_phases"], "the last phase is no whole one"
    for seed in range(2):
        state, facts = PPG_AGENT.run(PPG_AGENT.init(seed), number)
        one = jax.tree.map(lambda x, seed=seed: x[seed], states)
        assert int(one.iteration) == int(state.iteration) == number
        # Another batch of the same sums is rounded differently, and that adds up.
        assert_close(one.networks, state.networks, atol=2e-3)
        for name, fact in facts.items():
            length = 2 if name.startswith("auxiliary/") else number
            assert metrics[name].shape == (2, length)
            np.testing.assert_allclose(metrics[name][seed, -1], fact, rtol=0.02, atol=0.02)
