"""Initial states that are made once have the distribution of new ones."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.stats import ks_2samp

import pixelbrax_jax as pb

NUM_STARTS = 512
TASK = "dmc_cheetah_run"


def make(num_starts, **options):
    return pb.make(TASK, num_starts=num_starts, height=4, width=4, obs_mode="state", **options)


def first_observations(num_starts, num_envs):
    env, params = make(num_starts)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(3), np.arange(num_envs))
    reset = jax.jit(jax.vmap(env.reset, (0, None)))
    return np.asarray(reset(keys, params)[1].obs)


def test_episodes_begin_with_one_of_them():
    drawn = np.unique(first_observations(NUM_STARTS, 2048), axis=0)
    assert 0.95 * NUM_STARTS < len(drawn) <= NUM_STARTS
    for known, fresh in zip(drawn.T, first_observations(0, 2048).T, strict=True):
        assert ks_2samp(known, fresh).pvalue > 1e-3


def test_an_environment_draws_the_same_whatever_the_number_of_them():
    np.testing.assert_array_equal(
        first_observations(NUM_STARTS, 2048)[:3], first_observations(NUM_STARTS, 3)
    )


def test_equal_options_are_equal_physics():
    one, other = make(NUM_STARTS)[0].physics, make(NUM_STARTS)[0].physics
    assert one == other
    assert one != make(0)[0].physics
    assert sum(rows.nbytes for rows in jax.tree.leaves(one._starts)) == NUM_STARTS * 18 * 4


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
