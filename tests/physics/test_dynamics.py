"""MuJoCo itself and MuJoCo XLA as engines of the same tasks."""

from __future__ import annotations

import os
import queue
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pixelbrax_jax as pb
from pixelbrax_jax.physics.mujoco import native, xla
from pixelbrax_jax.physics.mujoco.options import ENGINES, Engine
from pixelbrax_jax.physics.mujoco.xla import Mjx
from pixelbrax_jax.registry import make_physics
from pixelbrax_jax.tasks import DMC_TASKS

pytest.importorskip("dm_control", exc_type=ImportError)

TASK = "dmc_hopper_hop"
OF_EACH_DOMAIN = {row.domain: row.name for row in DMC_TASKS.values()}.values()


@pytest.fixture(scope="module")
def physics():
    return make_physics(TASK, engine="mujoco")


def play(physics, num_envs, num_steps=5):
    """States after some steps of random actions, the same for each environment's number."""

    def of_one(key):
        state = physics.reset(key)

        def step(state, key):
            state = physics.step(state, jax.random.uniform(key, (physics.action_size,), minval=-1))
            return state, state

        return jax.lax.scan(step, state, jax.random.split(key, num_steps))[1]

    keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(0)))(jnp.arange(num_envs))
    return jax.device_get(jax.jit(jax.vmap(of_one))(keys))


@pytest.mark.slow
@pytest.mark.parametrize("task", OF_EACH_DOMAIN)
def test_both_engines_take_the_same_step(task):
    ours, theirs = (make_physics(task, engine=engine) for engine in ("mujoco", "xla"))
    assert ours != theirs
    states = jax.tree.map(lambda x: x[:, -1], play(ours, 16).engine)
    actions = jax.random.uniform(jax.random.key(1), (16, ours.action_size), minval=-1)
    ours, theirs = (
        jax.jit(jax.vmap(lambda s, a, p=p: p.observe(*p.move(s, a))))(states, actions)
        for p in (ours, theirs)
    )
    far = np.abs(ours.engine.qvel - theirs.engine.qvel) / np.maximum(1, np.abs(ours.engine.qvel))
    assert np.quantile(far.max(axis=1), 0.9) < 1e-2
    np.testing.assert_allclose(ours.xpos, theirs.xpos, atol=1e-3)
    np.testing.assert_allclose(ours.reward, theirs.reward, atol=1e-3)


def test_bits_do_not_depend_on_the_number_of_environments_nor_of_threads(physics, monkeypatch):
    many = play(physics, 33)
    few = play(physics, 3)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[:3], b), many, few)
    monkeypatch.setattr(native, "num_cores", lambda: 3)
    monkeypatch.setattr(native, "_pools", queue.SimpleQueue())
    jax.tree.map(np.testing.assert_array_equal, many, play(physics, 33))


def test_an_environment_alone_is_one_of_many(physics):
    state = jax.jit(physics.reset)(jax.random.key(0))
    action = jnp.full(physics.action_size, 0.3)
    alone = jax.jit(physics.step)(state, action)
    rows = jax.tree.map(lambda x: jnp.stack([x] * 20), (state, action))
    together = jax.jit(jax.vmap(physics.step))(*rows)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[7]), alone, together)
    tall = jax.tree.map(lambda x: x.reshape(4, 5, *x.shape[1:]), rows[0])
    nested = jax.vmap(jax.vmap(physics.step, in_axes=(0, None)), in_axes=(0, None))(tall, action)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[3, 2]), alone, nested)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e12])
def test_a_row_that_diverges_ends_and_leaves_the_others_alone(physics, bad, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file
    keys = jax.random.split(jax.random.key(0), 3)
    states = jax.vmap(physics.reset)(keys)
    actions = jnp.zeros((3, physics.action_size))
    good = jax.vmap(physics.step)(states, actions)
    engine = states.engine.replace(qvel=states.engine.qvel.at[1, 0].set(bad))
    after = jax.vmap(physics.step)(states.replace(engine=engine), actions)
    assert after.non_finite.tolist() == after.terminated.tolist() == [False, True, False]
    np.testing.assert_array_equal(after.obs[::2], good.obs[::2])
    np.testing.assert_array_equal(after.xpos[1], states.xpos[1])
    actions = actions.at[2].set(jnp.nan)
    assert jax.vmap(physics.step)(states, actions).non_finite.tolist() == [False, False, True]


def test_gradients_are_those_of_mujoco_xla(physics):
    def speed(physics, action):
        state = physics.step(physics.reset(jax.random.key(0)), action)
        return state.engine.qvel[0]

    action = jnp.zeros(physics.action_size)
    with pytest.raises(NotImplementedError, match="no derivatives: choose engine='xla'"):
        jax.grad(partial(speed, physics))(action)


@pytest.mark.slow
def test_mujoco_xla_has_gradients():
    physics = make_physics("dmc_pendulum_swingup", engine="xla")
    state = physics.reset(jax.random.key(0))

    def position(action):
        return physics.dynamics.step(state.engine.replace(ctrl=action), 1)[0].qvel[0]

    gradient = jax.jacfwd(position)(jnp.zeros(1))
    step = (position(jnp.full(1, 1e-2)) - position(jnp.full(1, -1e-2))) / 2e-2
    np.testing.assert_allclose(gradient[0], step, rtol=1e-2)


def test_the_engine_is_chosen_when_a_program_is_lowered(physics):
    auto = make_physics(TASK)
    state = jax.eval_shape(auto.reset, jax.random.key(0))
    action = jax.ShapeDtypeStruct((auto.action_size,), jnp.float32)
    step = jax.jit(auto.step).trace(state, action)
    assert "pixelbrax_host_call" in step.lower(lowering_platforms=("cpu",)).as_text()
    assert "pixelbrax_host_call" not in step.lower(lowering_platforms=("cuda",)).as_text()
    with pytest.raises(NotImplementedError, match="engine='mujoco' computes on a CPU alone"):
        jax.jit(physics.step).trace(state, action).lower(lowering_platforms=("cuda",))


def test_small_models_are_stepped_by_mujoco_xla():
    small = make_physics("dmc_pendulum_swingup")
    state = jax.eval_shape(small.reset, jax.random.key(0))
    step = jax.jit(small.step).lower(state, jax.ShapeDtypeStruct((1,), jnp.float32))
    assert "pixelbrax_host_call" not in step.as_text()
    reset = jax.jit(small.reset).lower(jax.random.key(0))
    assert "pixelbrax_host_call" in reset.as_text()


def test_an_engine_is_a_row(monkeypatch):
    class Mine(Mjx):
        pass

    monkeypatch.setattr(xla, "Mine", Mine, raising=False)
    monkeypatch.setitem(ENGINES, "mine", Engine("xla:Mine"))
    physics = make_physics("dmc_pendulum_swingup", engine="mine")
    assert isinstance(physics.dynamics.xla, Mine)
    state = jax.eval_shape(physics.reset, jax.random.key(0))
    # It computes on every device, so nothing is chosen.
    assert "by_platform" not in str(jax.make_jaxpr(physics.step)(state, jnp.zeros(1)))


def test_engines_are_options_of_the_suite():
    with pytest.raises(ValueError, match=r"unknown engine: 'mujco'\. Did you mean 'mujoco'"):
        pb.make(TASK, engine="mujco")
    with pytest.raises(ValueError, match="engine='xla' is only for tasks of the DM Control Suite"):
        pb.make("ant", engine="xla")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no processes are forked here")
@pytest.mark.filterwarnings("ignore:.*fork.*")
def test_a_forked_process_has_threads_of_its_own(physics):
    """Without JAX, which cannot be used after a fork."""
    engine, model = physics.dynamics.native, physics.dynamics.model
    rows = 64
    sizes = (model.nq, model.nv, 0, model.nv, model.nu, 0)
    state = [np.zeros((rows, size), np.float32) for size in sizes]
    state[0][:] = model.qpos0
    shapes = (model.nq,), (model.nv,), (0,), (model.nv,), (model.nq,)
    shapes += (model.nbody, 3), (model.nbody, 4)

    def step():
        results = [np.zeros((rows, *s), np.float32) for s in (*shapes, (model.nsensordata,))]
        engine.step(4, *state, *results)
        return results[0]

    expected = step()
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.write(writer, b"same" if (step() == expected).all() else b"different")
        os._exit(0)
    os.close(writer)
    assert os.read(reader, 20) == b"same"
    assert os.waitpid(child, 0)[1] == 0
