"""The phases of PPG and DCPG that learn from several rollouts; DCPG's variants."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax.agents.on_policy.dcpg import DCPG, Dynamics, dynamics_loss
from pixelbrax_jax.agents.on_policy.phasic import Chunk
from pixelbrax_jax.agents.rollout import observations
from tests.agents.small import (
    AGENTS,
    PHASIC,
    SMALL,
    Agent,
    assert_close,
    same,
    small_agent,
)

NUM_AUX_STEPS = PHASIC["aux_epochs"] * PHASIC["aux_minibatches"]
ROLLOUTS = PHASIC["num_policy_phases"]


PPG_AGENT, DCPG_AGENT, DECOUPLED = (AGENTS[name] for name in ("ppg", "dcpg", "decoupled"))


@pytest.fixture(
    params=[pytest.param("ppg", marks=pytest.mark.slow), "dcpg", "decoupled"],
)
def agent(request):
    return AGENTS[request.param]


def full(agent: Agent):
    """Before the first auxiliary phase."""
    state = agent.init()
    for _ in range(ROLLOUTS):
        state, _ = agent.iterate(state)
    return state


def test_rollouts_are_remembered_in_turn(agent):
    state, slots = agent.init(), []
    for _ in range(ROLLOUTS + 1):
        before = state.buffer
        state, _ = agent.iterate(state)
        changed = [
            not same(*(jax.tree.map(lambda x, p=p: x[p], b) for b in (before, state.buffer)))
            for p in range(ROLLOUTS)
        ]
        slots.append(changed)
    assert slots == [[True, False], [False, True], [True, False]]


def test_each_phase_has_an_adam_of_its_own(agent):
    state = full(agent)
    after, _ = agent.auxiliary(state)
    assert same(after.opt_state, state.opt_state)
    assert {int(m.count) for m in state.aux_opt_state.values()} == {0}
    assert {int(m.count) for m in after.aux_opt_state.values()} == {NUM_AUX_STEPS}
    steps = ROLLOUTS * SMALL["num_minibatches"]
    assert {int(m.count) for m in after.opt_state.values()} == {steps}
    # Everything else is as it was.
    names = ("env_state", "scaler", "buffer", "key", "iteration")
    for name in names:
        assert same(getattr(after, name), getattr(state, name))


def test_a_phase_without_steps_finds_the_policy_that_it_must_keep(agent):
    state, _ = agent.run(agent.init(), ROLLOUTS + 1)
    state, _ = agent.iterate(agent.without_steps(state))
    after, facts = agent.auxiliary(state)
    for name in state.networks:
        assert name == "target" or same(after.networks[name], state.networks[name])
    assert abs(float(facts["auxiliary/kl"])) < 1e-7


def test_the_phase_after_the_last_rollout_still_learns(agent):
    """Annealed, the step size would be 0 in the iteration that does not come any more."""
    state = full(agent).replace(iteration=jnp.uint32(agent.config.num_iterations))
    after, _ = agent.auxiliary(state)
    assert not same(after.networks["actor"], state.networks["actor"])


def test_steps_that_teach_nothing_change_no_auxiliary_phase(agent):
    state = full(agent)
    valid = state.buffer.valid
    assert not bool(valid.all())
    strange = jnp.where(valid, state.buffer.returns, 1e6)
    expected, _ = agent.auxiliary(state)
    actual, _ = agent.auxiliary(state.replace(buffer=state.buffer.replace(returns=strange)))
    assert same(actual.networks, expected.networks)
    # Of the others each one counts.
    t, i = np.argwhere(np.asarray(valid[1]))[-1]
    returns = state.buffer.returns.at[1, t, i].add(1.0)
    other, _ = agent.auxiliary(state.replace(buffer=state.buffer.replace(returns=returns)))
    assert not same(other.networks["actor"], expected.networks["actor"])


@pytest.mark.slow
def test_dcpg_s_value_stays_where_it_was_while_the_policy_learns():
    agent = small_agent(DCPG, anneal=False, update_epochs=16, value_distill_coef=100.0)
    before = agent.init(2)
    after, _ = agent.iterate(before)
    times = jnp.broadcast_to(jnp.arange(8)[:, None], (8, 4))
    frames = jax.tree.map(lambda x: x[0], after.buffer.frames)
    pixels = observations(frames, times, agent.config.random_shift)
    (old_policy, old), (policy, new) = (
        agent.algorithm.agent(state.networks, pixels, None) for state in (before, after)
    )

    def size(x):
        return math.sqrt(float(jnp.mean(x**2)))

    # 32 steps that would have brought it to the returns, and move the policy.
    assert size(after.buffer.returns[0].reshape(-1) - old) > 1.0
    assert size(policy.mean - old_policy.mean) > 0.05
    assert size(new - old) < 0.02


def test_dcpg_s_value_head_has_no_gradient_while_values_are_the_old_ones():
    """With one minibatch the value is the old one at the only step: returns do not reach it."""
    agent = small_agent(DCPG, num_minibatches=1)
    before = agent.init()
    after, facts = agent.iterate(before)
    old, new = (state.networks["actor"]["params"] for state in (before, after))
    assert float(facts["policy/clip_fraction"]) == 0.0
    assert not same(new["mean"], old["mean"])
    assert not same(new["Small_0"], old["Small_0"])
    # Rounding makes a gradient of some 1e-9, which Adam's epsilon keeps small.
    assert_close(new["value"], old["value"], atol=1e-5)


def test_a_dynamics_head_without_weight_changes_nothing():
    agent = small_agent(DCPG, dynamics_coef=1e-30)
    plain, state = full(DCPG_AGENT), agent.init()
    head = state.networks["dynamics"]
    assert same(state.networks, DCPG_AGENT.init().networks | {"dynamics": head})
    # The policy phase does not know of the head.
    state = state.replace(
        **{
            name: getattr(plain, name)
            for name in ("opt_state", "env_state", "scaler", "buffer", "iteration")
        },
        networks=plain.networks | {"dynamics": head},
    )
    expected, _ = DCPG_AGENT.auxiliary(plain)
    actual, _ = agent.auxiliary(state)
    # Another program rounds in another way.
    assert_close(actual.networks["actor"], expected.networks["actor"], atol=1e-6)


def test_the_averaged_actor_moves_in_the_auxiliary_phase_alone():
    state = DECOUPLED.init()
    assert same(state.networks["target"], state.networks["actor"])
    first = state.networks
    for _ in range(ROLLOUTS):
        state, _ = DECOUPLED.iterate(state)
        assert same(state.networks["target"], first["target"])
        assert same(state.networks["dynamics"], first["dynamics"])
    assert not same(state.networks["critic"], first["critic"])
    # Without steps of the optimiser the actor stands still, and the average comes nearer.
    state = state.replace(iteration=jnp.uint32(DECOUPLED.config.num_iterations + 1))
    after, _ = DECOUPLED.auxiliary(state)
    left = (1 - DECOUPLED.config.target_rate) ** NUM_AUX_STEPS
    expected = jax.tree.map(
        lambda target, actor: left * target + (1 - left) * actor,
        state.networks["target"],
        state.networks["actor"],
    )
    assert_close(after.networks["target"], expected, atol=1e-5)


def chunk_of(weight, key=0) -> Chunk:
    """Three steps of two environments; only what the dynamics loss reads."""
    raw = jax.random.normal(jax.random.key(key), (6, 1))
    weight = jnp.asarray(weight, jnp.float32)
    return Chunk(None, None, raw, None, weight, None, 3)


@pytest.fixture(scope="module")
def dynamics():
    features = jax.random.normal(jax.random.key(1), (6, 4))
    params = Dynamics().init(jax.random.key(2), features, jnp.zeros((6, 1)), features)
    return params, features


def test_the_dynamics_loss_of_a_guess_is_that_of_three_coins(dynamics):
    params, features = dynamics
    blank = jax.tree.map(jnp.zeros_like, params)
    loss = dynamics_loss(blank, features, chunk_of(np.ones(6)), jax.random.key(0))
    # Weights 1, 1/2 and 1.
    assert float(loss) == pytest.approx(2.5 * math.log(2))


def test_pairs_that_an_episode_s_end_parts_are_left_out(dynamics):
    params, features = dynamics
    # Columns are environments: of the first environment the second step only begins an episode.
    weight = np.array([[1, 1], [0, 1], [1, 1]]).T.reshape(-1)

    @jax.grad
    def gradient(features, weight):
        return dynamics_loss(params, features, chunk_of(weight), jax.random.key(0))

    slopes = np.asarray(gradient(features, weight)).reshape(2, 3, 4).swapaxes(0, 1)
    assert (slopes != 0).any(-1).all()
    # Nothing is left where no step counts, though the last of them leads nowhere.
    weight = np.array([[0, 0], [0, 0], [1, 1]]).T.reshape(-1)
    np.testing.assert_array_equal(gradient(features, weight), 0)
    # The first step of the second environment alone: to its first features no other pair leads.
    weight = np.array([[0, 1], [0, 0], [1, 1]]).T.reshape(-1)
    slopes = np.asarray(gradient(features, weight)).reshape(2, 3, 4).swapaxes(0, 1)
    assert (slopes[0, 1] != 0).any()
    assert (slopes[0, 0] == 0).all()
