"""Batches: autoreset modes, independence of environments, masks."""

from __future__ import annotations

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pixelbrax_jax as pb
from pixelbrax_jax import PixelEnv, VectorPixelEnv
from pixelbrax_jax.envs import param_rows
from tests.envs import toy
from tests.envs.toy import Ball

N = 5
PARAMS = toy.limited(20)
# Environment 0 goes left for ever, the others reach the end at different times.
ACTIONS = jnp.array([-0.2, 0.5, 0.7, 0.9, 1.0])[:, None]


def make(mode: str, num_envs: int = N, **options) -> VectorPixelEnv:
    options = {"height": 12, "width": 12, "frame_stack": 2} | options
    return VectorPixelEnv(PixelEnv(Ball(), **options), num_envs, mode)


def run(venv: VectorPixelEnv, num_steps: int, actions=ACTIONS):
    state, first = venv.reset(jax.random.key(0), PARAMS)
    steps = [first]
    for _ in range(num_steps):
        state, timestep = venv.step(state, actions, PARAMS)
        steps.append(timestep)
    return state, steps


def expected_episodes(env: PixelEnv, key, action, num_steps: int):
    """What one environment goes through, episode by episode, by its own functions."""
    state, timestep = env.reset(key, PARAMS)
    episodes = [[timestep]]
    for _ in range(num_steps):
        if state.done:
            state, timestep = env.next_episode(state, PARAMS)
            episodes.append([timestep])
        else:
            state, timestep = env.step(state, action, PARAMS)
            episodes[-1].append(timestep)
    return episodes


def assert_same_pixels(actual, expected):
    # Another batch size may round a silhouette's pixel the other way.
    difference = np.abs(np.asarray(actual).astype(int) - np.asarray(expected).astype(int))
    assert np.mean(difference > 1) <= 0.01


@pytest.mark.parametrize("mode", ["next_step", "same_step"])
def test_every_environment_goes_through_its_own_episodes(mode):
    num_steps = 45
    venv = make(mode)
    _, steps = run(venv, num_steps)
    ends = 0
    for i in range(N):
        key = jax.random.fold_in(jax.random.key(0), i)
        episodes = expected_episodes(venv.env, key, ACTIONS[i], num_steps)
        t = 0
        for number, episode in enumerate(episodes):
            for k, expected in enumerate(episode):
                if mode == "same_step" and k == 0 and number > 0:
                    continue  # shown together with the previous episode's last step
                if t > num_steps:
                    break
                actual = steps[t]
                last = bool(expected.terminated | expected.truncated)
                assert float(actual.reward[i]) == pytest.approx(float(expected.reward), abs=1e-5)
                assert bool(actual.terminated[i]) == bool(expected.terminated)
                assert bool(actual.truncated[i]) == bool(expected.truncated)
                if mode == "same_step" and last:
                    ends += 1
                    assert_same_pixels(actual.info["final_obs"][i], expected.obs)
                    final = actual.info["final_info"]
                    assert int(final["episode_length"][i]) == int(expected.info["episode_length"])
                    assert int(actual.info["episode_length"][i]) == 0
                    if number + 1 < len(episodes):
                        assert_same_pixels(actual.obs[i], episodes[number + 1][0].obs)
                else:
                    ends += last
                    assert_same_pixels(actual.obs[i], expected.obs)
                    length = int(actual.info["episode_length"][i])
                    assert length == int(expected.info["episode_length"])
                t += 1
    assert ends >= N


def test_disabled_resets_only_by_mask():
    venv = make("disabled")
    state, steps = run(venv, 20)
    assert bool(steps[-1].truncated[0])
    done = np.asarray(state.done)
    assert done.all()
    mask = jnp.arange(N) == 2
    after, timestep = venv.reset_where(state, mask, PARAMS)
    assert int(after.sim.episode[2]) == 1
    assert int(after.sim.step_count[2]) == 0
    assert not bool(after.done[2])
    for i in (0, 1, 3, 4):
        same = jax.tree.map(
            lambda old, new, i=i: (
                bool((jax.random.key_data(old[i]) == jax.random.key_data(new[i])).all())
                if jnp.issubdtype(old.dtype, jax.dtypes.prng_key)
                else bool((old[i] == new[i]).all())
            ),
            state,
            after,
        )
        assert all(jax.tree.leaves(same))
        np.testing.assert_array_equal(timestep.obs[i], steps[-1].obs[i])
    fresh = np.asarray(timestep.obs[2])
    np.testing.assert_array_equal(fresh[..., :3], fresh[..., 3:])


def test_reset_where_with_keys_begins_episode_zero():
    venv = make("next_step")
    state, _ = run(venv, 7)
    keys = jax.random.split(jax.random.key(9), N)
    after, timestep = venv.reset_where(state, jnp.ones(N, bool), PARAMS, keys)
    expected, first = venv.reset(keys, PARAMS)
    np.testing.assert_array_equal(timestep.obs, first.obs)
    np.testing.assert_array_equal(after.sim.physics.obs, expected.sim.physics.obs)
    assert (np.asarray(after.sim.episode) == 0).all()


@pytest.mark.parametrize("mode", ["next_step", "same_step"])
def test_one_end_leaves_the_others_untouched(mode):
    """The same batch with and without environment 3 ending: all others agree to the bit."""
    venv = make(mode)
    quiet = ACTIONS.at[3].set(0.0)
    _, busy_steps = run(venv, 16, ACTIONS.at[1:3].set(0.0).at[4].set(0.0))
    _, quiet_steps = run(venv, 16, quiet.at[1:3].set(0.0).at[4].set(0.0))
    assert any(bool(step.terminated[3]) for step in busy_steps)
    assert not any(bool(step.terminated.any()) for step in quiet_steps)
    others = np.array([0, 1, 2, 4])
    for busy, calm in zip(busy_steps, quiet_steps, strict=True):
        np.testing.assert_array_equal(busy.obs[others], calm.obs[others])
        np.testing.assert_array_equal(busy.reward[others], calm.reward[others])


@pytest.mark.parametrize("num_envs", [1, 33, 70])
def test_more_ends_than_one_block_and_ragged_batches(num_envs):
    venv, params = make("next_step", num_envs, obs_mode="state"), toy.limited(3)
    state, first = venv.reset(jax.random.key(0), params)
    starts = np.asarray(first.obs[:, 0])
    for _ in range(4):
        state, timestep = venv.step(state, jnp.zeros((num_envs, 1)), params)
    assert (np.asarray(state.sim.episode) == 1).all()
    fresh = np.asarray(timestep.obs[:, 0])
    assert (fresh != starts).all()
    assert len(np.unique(fresh)) == num_envs


def test_works_inside_scan_and_is_traced_once():
    venv = make("next_step")
    traces = []

    @jax.jit
    def rollout(state, params):
        traces.append(None)
        return jax.lax.scan(lambda s, _: venv.step(s, ACTIONS, params), state, length=45)

    state, _ = venv.reset(jax.random.key(0), PARAMS)
    state, scanned = rollout(state, PARAMS)
    rollout(state, PARAMS)
    assert len(traces) == 1
    _, steps = run(venv, 45)
    np.testing.assert_array_equal(scanned.truncated, [step.truncated for step in steps[1:]])
    assert_same_pixels(scanned.obs[-1], steps[-1].obs)


def test_bad_options_and_arguments():
    with pytest.raises(ValueError, match="num_envs must be a positive integer, got 0"):
        make("next_step", 0)
    with pytest.raises(
        ValueError, match=r"unknown autoreset_mode: 'next'.*Did you mean 'next_step'"
    ):
        make("next")
    venv = make("next_step", obs_mode="state")
    state, _ = venv.reset(jax.random.key(0), PARAMS)
    with pytest.raises(ValueError, match=r"action must have shape \(5, 1\), got \(5,\)"):
        venv.step(state, jnp.zeros(5), PARAMS)
    with pytest.raises(TypeError, match="floating point"):
        venv.step(state, jnp.zeros((5, 1), int), PARAMS)
    with pytest.raises(ValueError, match="mask must be bool of shape"):
        venv.reset_where(state, jnp.ones(4, bool), PARAMS)
    with pytest.raises(ValueError, match="mask must be bool of shape"):
        venv.reset_where(state, [True], PARAMS)
    with pytest.raises(TypeError, match=r"key must have shape \(5,\)"):
        venv.reset(jax.random.split(jax.random.key(0), 4), PARAMS)


def test_a_step_that_ends_no_episode_computes_no_first_state():
    env, params = pb.make("inverted_pendulum", obs_mode="state")
    venv = VectorPixelEnv(env, 2)
    state, _ = jax.eval_shape(venv.reset, jax.random.key(0), params)

    def reset_rows(state, params):
        rows = param_rows.split_params(params, venv.num_envs)
        return venv._reset_rows(state, state.done, state.sim.episode, rows)

    program = jax.jit(reset_rows).lower(state, params).compile().as_text()
    # XLA may take out of a loop what its turns have in common, such as physics at the first pose;
    # then every step pays for it.
    every_step = program[program.index("ENTRY") :]
    assert " while(" in every_step
    assert " dot(" not in every_step
    assert every_step.count(" fusion(") < 50


def own_params(num_envs: int = 2) -> tuple[list[pb.EnvParams], pb.EnvParams]:
    """Parameters of single environments, and the same of a batch: with rows where they differ."""
    single = [
        PARAMS.replace(
            rig=PARAMS.rig.replace(eye=np.array([i, -4.0, 1.0], np.float32)),
            look=PARAMS.look.replace(ambient=np.float32(0.2 + 0.3 * i)),
            episode_length=np.int32(3 + 4 * i),
        )
        for i in range(num_envs)
    ]
    stacked = jax.tree.map(lambda *rows: np.stack(rows), *single)
    batch = PARAMS.replace(
        rig=PARAMS.rig.replace(eye=stacked.rig.eye),
        look=PARAMS.look.replace(ambient=stacked.look.ambient),
        episode_length=stacked.episode_length,
    )
    return single, batch


def test_environments_may_have_parameters_of_their_own():
    venv, (single, batch) = make("next_step", 2, obs_mode="both"), own_params()
    actions = jnp.array([[0.1], [0.1]])
    state, first = venv.reset(jax.random.key(0), batch)
    steps, lengths = [first], []
    for _ in range(6):
        state, timestep = venv.step(state, actions, batch)
        steps.append(timestep)
        lengths.append(np.asarray(timestep.truncated))
    # The time limits of 3 and 7 control steps.
    assert np.argmax(np.array(lengths)[:, 0]) == 2
    assert not np.array(lengths)[:, 1].any()
    for i in range(2):
        key = jax.random.fold_in(jax.random.key(0), i)
        alone, expected = venv.env.reset(key, single[i])
        for t in range(4):
            if t:
                alone, expected = venv.env.step(alone, actions[i], single[i])
            actual = jax.tree.map(lambda x, i=i: x[i], steps[t])
            assert float(actual.reward) == pytest.approx(float(expected.reward), abs=1e-5)
            assert bool(actual.truncated) == bool(expected.truncated)
            assert_same_pixels(actual.obs["pixels"], expected.obs["pixels"])
    # They do look different.
    assert np.abs(np.diff(np.asarray(first.obs["pixels"]).astype(int), axis=0)).mean() > 5


def test_a_reset_of_some_draws_with_parameters_of_their_own():
    venv, (single, batch) = make("disabled", 2), own_params()
    state, _ = venv.reset(jax.random.key(0), batch)
    mask = jnp.array([False, True])
    _, timestep = venv.reset_where(state, mask, batch, jax.random.key(5))
    key = jax.random.fold_in(jax.random.key(5), 1)
    assert_same_pixels(timestep.obs[1], venv.env.reset(key, single[1])[1].obs)


def test_a_batch_on_a_cpu_in_chunks_has_parameters_of_its_own():
    venv = make("next_step", 256, obs_mode="state")
    limits = np.arange(256, dtype=np.int32) % 3 + 1
    params = PARAMS.replace(episode_length=limits)
    state, _ = venv.reset(jax.random.key(0), params)
    _, timestep = venv.step(state, jnp.zeros((256, 1)), params)
    np.testing.assert_array_equal(timestep.truncated, limits == 1)


@pytest.mark.parametrize(
    ("part", "field", "shape", "wanted", "rows"),
    [
        ("rig", "eye", (3, 3), "(3,)", "(2, 3)"),
        ("geoms", "rgb", (2, 3, 2), "(2, 3)", "(2, 2, 3)"),
        ("geoms", "rgb", (5, 3), "(2, 3)", "(2, 2, 3)"),
        ("geoms", "pos", (5, 3), "(2, 3)", "(2, 2, 3)"),
        ("look", "sky", (5, 3), "(2 or 3, 3)", "(2, 2 or 3, 3)"),
        ("", "episode_length", (2, 1), "()", "(2,)"),
    ],
)
def test_a_parameter_of_another_shape_is_named(part, field, shape, wanted, rows):
    wrong = {field: np.zeros(shape, np.float32)}
    params = PARAMS.replace(**{part: getattr(PARAMS, part).replace(**wrong)} if part else wrong)
    name = f"params.{part}.{field}" if part else f"params.{field}"
    message = re.escape(
        f"{name} must have shape {wanted}, the same for all environments, or {rows}, a row for "
        f"each of the num_envs=2; got {shape}"
    )
    venv = make("next_step", 2)
    with pytest.raises(ValueError, match=message):
        venv.reset(jax.random.key(0), params)
    state, _ = jax.eval_shape(venv.reset, jax.random.key(0), PARAMS)
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(venv.step, state, ACTIONS[:2], params)


def test_the_shape_of_every_parameter_is_known():
    # One has strings, the other a mirror; with clips these are all fields but a light.
    options = {"height": 12, "width": 12, "distractors": ("video",), "clips": "procedural"}
    dmc = options | {"look": "dmc"}
    cup, cartpole = pb.make("dmc_ball_in_cup_catch", **dmc), pb.make("dmc_cartpole_swingup", **dmc)
    for known in (PARAMS, cup[1], cartpole[1]):
        for path, leaf in jax.tree_util.tree_leaves_with_path(known):
            name = ".".join(key.name for key in path if hasattr(key, "name"))
            assert param_rows._fits(np.shape(leaf), param_rows._SHAPES[name]), name
        assert not any(param_rows.split_params(known, 7).is_own)
