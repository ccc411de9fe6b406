"""Whole iterations of DrQ-v2, and runs that are stopped."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax.agents.off_policy.drqv2 import DrQv2
from pixelbrax_jax.agents.runner import train
from pixelbrax_jax.agents.runner.devices import check_memory
from pixelbrax_jax.agents.runner.settings import RunConfig
from pixelbrax_jax.agents.runner.train import run
from pixelbrax_jax.agents.runner.trained import save_policy
from pixelbrax_jax.policy import load_policy
from tests.agents.small import DRQV2, PARAMS, ball_envs, same, small_agent
from tests.agents.test_pretrained import SOURCES

# One update in each iteration, from the second one on.
LATE = small_agent(
    DrQv2,
    learning_starts=64,
    anneal=False,
    replay_ratio=1 / 32,
    std_steps=64,
    initial_std=0.8,
    final_std=0.2,
)
KEY = jax.random.key(0)


@pytest.mark.slow
def test_the_same_key_gives_the_same_run_and_another_another():
    first, facts = DRQV2.run(DRQV2.init(), 3)
    second, more_facts = DRQV2.run(DRQV2.algorithm.init(KEY, PARAMS), 3)
    assert same(first, second)
    assert same(facts, more_facts)
    other, _ = DRQV2.run(DRQV2.init(1), 3)
    assert not same(first.networks, other.networks)
    assert all(np.isfinite(fact) for fact in facts.values())


def test_learning_waits_for_the_replay_and_actions_are_uniform_until_then():
    start = LATE.init()
    state, facts = LATE.iterate(start)
    assert same(state.networks, start.networks)
    assert (int(facts["updates"]), int(facts["replay/size"])) == (0, 32)
    assert not same(LATE.iterate(state)[0].networks, start.networks)
    # The same action for all would show the policy.
    assert np.std(state.replay.action[:, :8]) > 0.4


def test_the_target_follows_the_critic():
    state, _ = LATE.run(LATE.init(), 2)
    after, facts = LATE.iterate(state)
    assert int(facts["updates"]) == 1
    expected = jax.tree.map(
        lambda target, critic: 0.99 * target + 0.01 * critic, state.target, after.networks["critic"]
    )
    for found, wanted in zip(*map(jax.tree.leaves, (after.target, expected)), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-7)


def test_noise_follows_its_schedule():
    state, found = LATE.init(), []
    for _ in range(4):
        state, facts = LATE.iterate(state)
        found.append(float(facts["policy/std"]))
    np.testing.assert_allclose(found, [0.8, 0.5, 0.2, 0.2], rtol=1e-6)
    # Of 32 steps each, which are 2**32 together.
    _, facts = LATE.iterate(LATE.init().replace(iteration=jnp.uint32(2**27)))
    assert float(facts["policy/std"]) == pytest.approx(0.2)


@pytest.mark.slow
def test_the_actor_learns_in_every_second_update_of_a_lower_precision():
    agent = small_agent(DrQv2, policy_delay=2, critic="c51", bfloat16=True, layer_norm=True)
    state, facts = agent.run(agent.init(), 2)
    # 4 updates in each iteration.
    counts = {name: int(moments.count) for name, moments in state.opt_state.items()}
    assert counts == {"encoder": 8, "critic": 8, "actor": 4}
    assert {x.dtype for x in jax.tree.leaves(state.networks)} == {jnp.dtype("float32")}
    assert all(np.isfinite(fact) for fact in facts.values())


def test_no_turn_of_the_learning_loop_copies_the_replay():
    agent = small_agent(DrQv2, buffer_size=640)
    iterate = jax.jit(lambda state: agent.algorithm.iterate(state, PARAMS), donate_argnums=0)
    program = iterate.lower(jax.eval_shape(agent.algorithm.init, KEY, PARAMS)).compile().as_text()
    frames = r"u8\[4,160,18,18,3\]\S* copy\("
    assert re.search(r"u8\[4,160,18,18,3\]", program)
    assert not re.search(frames, program)


@pytest.mark.parametrize("stored", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_resumed_run_goes_on_with_or_without_its_replay(tmp_path, stored):
    def algorithm(iterations):
        config = LATE.config.replace(checkpoint_replay=stored, total_steps=32 * iterations)
        return DrQv2(config, ball_envs())

    def options(folder, **changes):
        return RunConfig(str(tmp_path / folder), progress=False, **changes)

    lines = []
    whole = run(algorithm(5), PARAMS, options("whole"), report=lines.append).state
    assert any(", replay 0.00 GB" in line for line in lines)
    run(algorithm(3), PARAMS, options("parts"))
    resuming = options("parts", resume="latest")
    resumed = run(algorithm(5), PARAMS, resuming, report=lines.append)
    assert same(resumed.state, whole) == stored
    told = "not in the checkpoint: replay; filled anew before learning goes on"
    assert (told in lines) != stored
    if not stored:
        # One of the two iterations fills it, and the schedule goes on.
        assert int(resumed.state.replay.count) == 16
        assert int(resumed.state.opt_state["critic"].count) == (3 - 1) + 1
        assert same(resumed.state.env_state.sim.episode, whole.env_state.sim.episode)


@pytest.mark.parametrize(("iterations", "learns"), [(3, True), (4, False)])
def test_a_resumed_run_says_whether_it_learns_on(iterations, learns):
    config = LATE.config.replace(total_steps=32 * 5)
    state = SimpleNamespace(iteration=np.int32(iterations))
    told = train._filled_anew(["replay"], state, config)
    assert told.endswith("filled anew before learning goes on") == learns
    assert ("first 64 of the agent's steps, and only 32 are left" in told) != learns


def test_a_replay_that_does_not_fit_beside_the_state_is_told_with_the_largest(tmp_path):
    config = LATE.config.replace(buffer_size=640, memory_budget_gb=0.7e-3)
    options = RunConfig(str(tmp_path), progress=False)
    with pytest.raises(MemoryError, match=r"Lower buffer_size .* the largest that fits is") as info:
        run(DrQv2(config, ball_envs()), PARAMS, options)
    largest = int(re.findall(r"buffer_size=(\d+)", str(info.value))[-1])
    assert 32 <= largest < 640
    fitting = DrQv2(config.replace(buffer_size=largest), ball_envs())
    check_memory(fitting, jax.eval_shape(fitting.init, KEY, PARAMS), report=lambda line: None)


@pytest.mark.slow
def test_returns_outside_the_range_of_c51_are_told_once(tmp_path):
    narrow = replace(LATE.config, critic="c51", v_min=-0.01, v_max=0.01)
    lines = []
    options = RunConfig(str(tmp_path), progress=False)
    run(DrQv2(narrow, ball_envs()), PARAMS, options, report=lines.append)
    told = [line for line in lines if "leave the range of c51, v_min=-0.01 to v_max=0.01" in line]
    assert len(told) == 1


def test_a_policy_in_a_file_acts_as_the_agent(tmp_path):
    networks = DRQV2.init().networks
    path = save_policy(DRQV2.algorithm, networks, tmp_path / "policy.jax")
    assert not SOURCES.search(path.read_bytes())
    pixels = np.random.default_rng(0).integers(0, 256, (5, 18, 18, 6), np.uint8)
    expected = DRQV2.algorithm.act(networks, jnp.asarray(pixels))
    np.testing.assert_allclose(load_policy(path)(pixels), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_seeds_of_one_program_are_those_of_their_own(tmp_path):
    config = LATE.config.replace(total_steps=32 * 3)
    agent, options = DrQv2(config, ball_envs()), RunConfig(str(tmp_path / "2"), progress=False)
    both = run(agent, PARAMS, replace(options, seeds=2)).state
    alone = run(agent, PARAMS, RunConfig(str(tmp_path / "1"), seed=1, progress=False)).state
    for found, wanted in zip(*map(jax.tree.leaves, (both.networks, alone.networks)), strict=True):
        np.testing.assert_allclose(found[1], wanted, rtol=1e-4, atol=1e-5)
