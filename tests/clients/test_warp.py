"""MuJoCo Warp as the engine: it computes on a CPU, too, and steps as MuJoCo XLA does there."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pixelbrax_jax as pb

# Warp compiles some sixty kernels for a model, a minute or two on a CPU.
pytestmark = pytest.mark.timeout(900)

NUM_ENVS = 3


def venv(task: str, engine: str, dynamics: Any = "") -> tuple[pb.VectorPixelEnv, pb.EnvParams]:
    env, params = pb.make(task, engine=engine, obs_mode="state", dynamics=dynamics)
    return pb.VectorPixelEnv(env, NUM_ENVS), params


def actions(env: pb.VectorPixelEnv) -> jax.Array:
    shape = (NUM_ENVS, env.env.action_size)
    return jax.random.uniform(jax.random.key(1), shape, minval=-1.0, maxval=1.0)


# A limit and RK4; contacts, ten physics steps; a tendon.
@pytest.mark.parametrize(
    ("task", "atol"),
    [("dmc_cartpole_swingup", 1e-6), ("dmc_walker_walk", 1e-4), ("dmc_ball_in_cup_catch", 1e-5)],
)
def test_steps_are_those_of_mujoco_xla(task, atol):
    def qpos(engine: str) -> np.ndarray:
        env, params = venv(task, engine)
        action = actions(env)

        @jax.jit
        def steps(key):
            state, _ = env.reset(key, params)
            step = lambda state, _: (env.step(state, action, params)[0], None)  # noqa: E731
            return jax.lax.scan(step, state, None, length=5)[0].sim.physics.engine.qpos

        return np.asarray(steps(jax.random.key(0)))

    ours, warp = qpos("xla"), qpos("warp")
    # Both compute in float32.
    np.testing.assert_allclose(warp, ours, atol=atol)
    assert not np.array_equal(warp[0], warp[1])


@cache
def started() -> tuple[pb.VectorPixelEnv, pb.EnvParams, pb.EnvState]:
    env, params = venv("dmc_cartpole_swingup", "warp")
    return env, params, jax.jit(env.reset)(jax.random.key(0), params)[0]


def moved(env, params, state, action) -> jax.Array:
    return env.step(state, action, params)[0].sim.physics.engine.qpos


def test_seeds_and_environments_are_rows_of_one_batch():
    env, params, state = started()
    action = actions(env)
    two = jax.jit(jax.vmap(partial(moved, env, params), (None, 0)))(
        state, jnp.stack([action, -action])
    )
    for row, sign in zip(two, (1, -1), strict=True):
        one = jax.jit(partial(moved, env, params))(state, sign * action)
        np.testing.assert_array_equal(row, one)


def test_dynamics_vary():
    dynamics = {"gravity": (0.5, 2.0), "mass": 1.1}
    results = []
    for engine in ("xla", "warp"):
        env, params = venv("dmc_cartpole_swingup", engine, dynamics)
        state, _ = jax.jit(env.reset)(jax.random.key(0), params)
        results.append(np.asarray(jax.jit(partial(moved, env, params))(state, actions(env))))
    np.testing.assert_allclose(*results, atol=1e-6)
    env, params, state = started()
    plain = jax.jit(partial(moved, env, params))(state, actions(env))
    assert np.abs(results[1] - plain).max() > 1e-5


def test_it_has_no_derivatives():
    env, params, state = started()
    with pytest.raises(
        NotImplementedError, match=r"engine=.warp. has no derivatives.*engine='xla'"
    ):
        jax.jit(jax.grad(lambda action: moved(env, params, state, action).sum()))(actions(env))


def test_a_program_for_cuda_is_lowered_without_a_card():
    env, params, state = started()
    traced = jax.jit(partial(moved, env, params)).trace(state, actions(env))
    assert "jax_callable" in traced.lower(lowering_platforms=("cuda",)).as_text()


def test_forces_on_bodies_are_refused():
    with pytest.raises(ValueError, match=r"engine='warp' does not compute cfrc_ext.*engine='xla'"):
        pb.make("gym_ant", engine="warp")
