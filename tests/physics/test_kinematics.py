"""Poses: MuJoCo computes the same ones from the same joint positions."""

import jax
import mujoco
import numpy as np
import pytest

from pixelbrax_jax.tasks import BRAX_TASKS

ALL_TASKS = sorted(BRAX_TASKS)


ENLARGED = {name for spec in BRAX_TASKS.values() for name in spec.drawn_radius}
"""Geoms that are drawn larger than they are."""


def check_poses(model, physics, state, geom_pose):
    """Link and geom poses of ``state`` are MuJoCo's for its joint positions."""
    data = mujoco.MjData(model)
    data.qpos[:] = state.engine.pipeline.q
    mujoco.mj_kinematics(model, data)
    moving = np.flatnonzero(model.body_jntnum)
    assert len(moving) == len(physics.link_names)
    np.testing.assert_allclose(state.xpos, data.xpos[moving], atol=2e-5)
    # A quaternion and its negative are one rotation.
    cosine = np.abs(np.sum(np.asarray(state.xquat) * data.xquat[moving], axis=-1))
    np.testing.assert_allclose(cosine, 1, atol=1e-5)

    named = {model.geom(i).name: i for i in range(model.ngeom) if model.geom(i).name}
    unnamed = [i for i in range(model.ngeom) if not model.geom(i).name and visible(model, i)]
    for index, name in enumerate(physics.geoms.name):
        original = named[name] if name in named else unnamed.pop(0)
        pos, mat = geom_pose(physics.geoms, state, index)
        expected = data.geom_xmat[original].reshape(3, 3)
        np.testing.assert_allclose(pos, data.geom_xpos[original], atol=2e-5, err_msg=name)
        np.testing.assert_allclose(mat, expected, atol=2e-5, err_msg=name)
        assert physics.geoms.kind[index] == model.geom_type[original]
        used = np.asarray(physics.geoms.size[index])
        real = model.geom_size[original]
        if name in ENLARGED:
            assert used[0] > real[0]
        else:
            np.testing.assert_allclose(used[used > 0], real[used > 0], rtol=1e-6)
        assert used[0] > 0
    assert not unnamed


def visible(model, index):
    return model.geom_rgba[index, 3] > 0


@pytest.mark.parametrize("task", ALL_TASKS)
def test_a_reset_is_a_reproducible_unit_pose(task, program, unfused_model, geom_pose):
    # One test, because compiling the reset is what takes the time.
    compiled = program(task)
    physics = compiled.physics
    state = compiled.reset(jax.random.key(7))

    check_poses(unfused_model(task), physics, state, geom_pose)

    np.testing.assert_allclose(np.linalg.norm(state.xquat, axis=-1), 1, atol=1e-6)
    model = unfused_model(task)
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        start = model.jnt_qposadr[joint] + 3
        norm = np.linalg.norm(state.engine.pipeline.q[start : start + 4])
        np.testing.assert_allclose(norm, 1, atol=1e-6)

    assert state.xpos.shape == (len(physics.link_names), 3)
    assert state.xquat.shape == (len(physics.link_names), 4)
    assert state.obs.shape == (physics.state_size,)
    assert state.reward.shape == state.terminated.shape == state.non_finite.shape == ()
    for leaf in (state.xpos, state.xquat, state.obs, state.reward):
        assert leaf.dtype == np.float32
    assert state.terminated.dtype == state.non_finite.dtype == bool
    assert state.reward == 0
    assert not state.terminated
    assert not state.non_finite

    again = compiled.reset(jax.random.key(7))
    jax.tree.map(np.testing.assert_array_equal, state, again)
    other = compiled.reset(jax.random.key(8))
    assert not np.array_equal(state.obs, other.obs)
    assert not np.array_equal(state.xpos, other.xpos)


@pytest.mark.parametrize("task", ["ant", "humanoid", "humanoidstandup"])
def test_state_observation_holds_the_unit_quaternion(task, program):
    # The free joint's x and y are left out, so its quaternion is observed at 1 to 4.
    state = program(task).reset(jax.random.key(7))
    np.testing.assert_allclose(np.linalg.norm(state.obs[1:5]), 1, atol=1e-6)


def test_chosen_pose(program, unfused_model, geom_pose):
    compiled = program("ant")
    q = np.array(unfused_model("ant").qpos0, np.float32)
    q[:3] = 1, -2, 3
    q[3:7] = 0, 0, 3, 4  # not normalized
    q[7:] = np.linspace(-1, 1, 8)
    qd = np.linspace(-2, 2, 14).astype(np.float32)
    state = compiled.from_qpos(q, qd)
    check_poses(unfused_model("ant"), compiled.physics, state, geom_pose)
    unit = q.copy()
    unit[3:7] = 0, 0, 0.6, 0.8
    np.testing.assert_allclose(state.engine.pipeline.q, unit, atol=1e-6)
    np.testing.assert_allclose(state.obs, np.concatenate([unit[2:], qd]), atol=1e-6)


def test_chosen_pose_is_at_rest_unless_told_otherwise(program):
    state = program("inverted_pendulum").from_qpos(np.array([0.1, 0.2], np.float32))
    np.testing.assert_allclose(state.obs, [0.1, 0.2, 0, 0], atol=1e-7)


@pytest.mark.parametrize(("q", "qd"), [(np.zeros(3), None), (np.zeros(2), np.zeros(1))])
def test_chosen_pose_of_a_wrong_size(q, qd, program):
    with pytest.raises(ValueError, match=r"qpos and qvel must have shapes \(2,\) and \(2,\)"):
        program("inverted_pendulum").physics.from_qpos(q, qd)
