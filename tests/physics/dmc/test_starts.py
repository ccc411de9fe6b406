"""Initial states that are made once have the distribution of new ones."""

from __future__ import annotations

import functools
import pickle

import jax
import numpy as np
import pytest
from scipy.stats import ks_2samp

import pixelbrax_jax as pb

NUM_STARTS = 512


def make(num_starts, task="dmc_cheetah_run", **options):
    return pb.make(task, num_starts=num_starts, height=4, width=4, obs_mode="state", **options)


@functools.cache
def first_states(num_starts, num_envs, task="dmc_cheetah_run"):
    env, params = make(num_starts, task)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(3), np.arange(num_envs))
    reset = jax.jit(jax.vmap(lambda key: env.reset(key, params)[0].sim.physics))
    return jax.device_get(reset(keys))


def test_episodes_begin_with_one_of_them():
    drawn = np.unique(first_states(NUM_STARTS, 2048).obs, axis=0)
    assert 0.95 * NUM_STARTS < len(drawn) <= NUM_STARTS
    for known, fresh in zip(drawn.T, first_states(0, 2048).obs.T, strict=True):
        assert ks_2samp(known, fresh).pvalue > 1e-3


def test_an_environment_draws_the_same_whatever_the_number_of_them():
    np.testing.assert_array_equal(
        first_states(NUM_STARTS, 2048).obs[:3], first_states(NUM_STARTS, 3).obs
    )


def test_a_target_belongs_to_its_state():
    engine = first_states(8, 64, "dmc_reacher_easy").engine
    rows = {tuple(np.concatenate(pair)) for pair in zip(engine.qpos, engine.target, strict=True)}
    assert len(rows) == 8
    assert len({row[:2] for row in rows}) == len({row[2:] for row in rows}) == 8
    physics = make(8, "dmc_reacher_easy")[0].physics
    posed = physics.from_qpos(np.array([0.3, 0.4]), key=jax.random.key(1)).engine
    np.testing.assert_allclose(posed.qpos, [0.3, 0.4], atol=1e-6)
    assert any(np.array_equal(posed.target, row[2:]) for row in rows)


@pytest.mark.slow
def test_a_pose_has_the_forces_that_mujoco_computes():
    """Also where sampled states have none."""
    ours, theirs = (
        make(0, "dmc_finger_spin", engine=engine)[0].physics for engine in ("mujoco", "xla")
    )
    pose = np.array([0.25, -0.8, 1.0])
    expected, found = (jax.jit(p.from_qpos)(pose).obs for p in (ours, theirs))
    assert expected[-2:].max() > 0.1, "the finger touches the spinner"
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)


def test_equal_options_are_equal_physics_and_none_is_made_before_an_episode():
    one, other = make(NUM_STARTS)[0].physics, make(NUM_STARTS)[0].physics
    assert one == other == pickle.loads(pickle.dumps(one))
    assert one != make(0)[0].physics
    assert "_starts" not in vars(make(9)[0].physics)


@pytest.mark.parametrize(("num_starts", "loops"), [(0, True), (NUM_STARTS, False)])
def test_a_reset_for_a_gpu_settles_nothing(num_starts, loops):
    env, params = make(num_starts)
    lowered = jax.jit(env.reset).trace(jax.random.key(0), params)
    text = lowered.lower(lowering_platforms=("cuda",)).as_text()
    assert ("stablehlo.while" in text) == loops


def test_other_suites_and_numbers_are_refused():
    with pytest.raises(ValueError, match="num_starts=8 is only for tasks of"):
        pb.make("ant", num_starts=8)
    with pytest.raises(ValueError, match="num_starts must be a whole number of at least 0, got -1"):
        make(-1)
    with pytest.raises(MemoryError, match="num_starts=1000000000000 would take at least"):
        make(10**12)
