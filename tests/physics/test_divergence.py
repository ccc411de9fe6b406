"""Whatever is fed in, nothing that leaves the physics is NaN or infinite."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

VISIBLE = ("xpos", "xquat", "obs", "reward")


def assert_finite(state):
    for field in VISIBLE:
        assert np.isfinite(getattr(state, field)).all(), field


def assert_diverged(state, last):
    """``state`` reports a divergence and shows what ``last`` showed."""
    assert_finite(state)
    assert state.terminated.all()
    assert state.non_finite.all()
    assert (state.reward == 0).all()
    for field in ("xpos", "xquat", "obs"):
        np.testing.assert_array_equal(getattr(state, field), getattr(last, field))
    jax.tree.map(np.testing.assert_array_equal, state.engine, last.engine)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("task", ["walker2d", pytest.param("swimmer", marks=pytest.mark.slow)])
def test_bad_action_ends_the_episode(task, bad, program):
    compiled = program(task)
    good = np.zeros(compiled.physics.action_size, np.float32)
    first = compiled.reset(jax.random.key(1))
    last = compiled.step(first, good)
    assert not last.non_finite
    action = good.copy()
    action[0] = bad
    state = compiled.step(last, action)
    assert_diverged(state, last)
    # Stepping on is harmless, and the very state that was kept still works.
    assert_diverged(compiled.step(state, action), last)
    resumed = compiled.step(state, good)
    assert not resumed.non_finite
    np.testing.assert_array_equal(resumed.obs, compiled.step(last, good).obs)
    # Nothing of it reaches the next episode.
    jax.tree.map(np.testing.assert_array_equal, compiled.reset(jax.random.key(1)), first)


def test_constant_reward_is_withheld_too(program):
    compiled = program("inverted_pendulum")
    first = compiled.reset(jax.random.key(1))
    assert compiled.step(first, np.zeros(1, np.float32)).reward == 1
    assert_diverged(compiled.step(first, np.full(1, np.nan, np.float32)), first)


@pytest.mark.parametrize("speed", [1e6, 1e12, np.inf, np.nan])
def test_speeds_beyond_reason(speed, program):
    """A finite number so large that an image's arithmetic would overflow also diverged."""
    compiled = program("inverted_pendulum")
    pipeline = compiled.reset(jax.random.key(1))
    carry = pipeline.engine
    fast = carry.pipeline.replace(qd=jnp.full(2, speed, jnp.float32))
    state = compiled.step(pipeline.replace(engine=carry.replace(pipeline=fast)), np.zeros(1))
    assert_finite(state)
    assert np.abs(state.xpos).max() < 1e10
    assert state.terminated
    assert bool(state.non_finite) == (speed != 1e6)


def test_only_the_diverged_member_of_a_batch_is_affected(program):
    compiled = program("inverted_pendulum")
    resets = [compiled.reset(jax.random.key(i)) for i in range(3)]
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *resets)
    actions = jnp.zeros((3, 1)).at[1].set(jnp.nan)
    after = jax.jit(jax.vmap(compiled.physics.step))(states, actions)
    assert_finite(after)
    np.testing.assert_array_equal(after.non_finite, [False, True, False])
    np.testing.assert_array_equal(after.reward, [1, 0, 1])
