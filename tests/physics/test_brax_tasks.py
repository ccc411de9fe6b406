"""Brax's tasks: the table against figures taken from Brax's models by hand, and poses by MuJoCo."""

from collections import Counter

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pixelbrax_jax.physics.brax.loading import load_brax_env
from pixelbrax_jax.physics.brax.tasks import BACKENDS
from pixelbrax_jax.registry import make_physics
from pixelbrax_jax.tasks import BRAX_TASKS
from pixelbrax_jax.types import GeomKind

# task: (planes, capsules, spheres), actions, observations, dt by backend
FACTS = {
    "ant": ((1, 12, 5), 8, 27, {"spring": 0.05}),
    "halfcheetah": ((1, 8, 0), 6, 17, {"spring": 0.05}),
    "hopper": ((1, 4, 0), 3, 11, {"positional": 0.008}),
    "humanoid": ((1, 12, 5), 17, 244, {"spring": 0.015}),
    "humanoidstandup": ((1, 12, 5), 17, 244, {"spring": 0.015}),
    "inverted_double_pendulum": ((1, 4, 0), 1, 8, {"generalized": 0.02, "spring": 0.02}),
    "inverted_pendulum": ((0, 3, 0), 1, 4, {"generalized": 0.04, "spring": 0.02}),
    # Brax's pusher has one sphere more, with alpha 0.
    "pusher": ((1, 13, 6), 7, 23, {"generalized": 0.05}),
    "reacher": ((1, 7, 2), 2, 11, {"generalized": 0.02}),
    "swimmer": ((1, 3, 0), 2, 8, {"generalized": 0.04}),
    "walker2d": ((1, 7, 0), 6, 17, {"spring": 0.008}),
}
each_task = pytest.mark.parametrize("task", sorted(FACTS))

ENLARGED = {name for row in BRAX_TASKS.values() for name in row.drawn_radius}
"""Geoms that are drawn larger than they are."""


def test_all_eleven_tasks_of_brax():
    assert set(BRAX_TASKS) == set(FACTS)
    for row in BRAX_TASKS.values():
        assert row.default_backend in row.backends
        assert set(row.backends) <= set(BACKENDS)
        assert list(row.backends) == sorted(row.backends)


@each_task
def test_sizes_and_times(task, program):
    kinds, actions, observations, times = FACTS[task]
    physics = program(task).physics
    count = Counter(physics.geoms.kind)
    assert tuple(count[k] for k in (GeomKind.PLANE, GeomKind.CAPSULE, GeomKind.SPHERE)) == kinds
    assert (physics.action_size, physics.state_size) == (actions, observations)
    assert physics.backend == BRAX_TASKS[task].default_backend
    assert len(set(physics.link_names)) == len(physics.link_names)
    # The model's own number, which Brax keeps in float32.
    assert physics.dt == times[physics.backend]
    for backend in times:
        assert make_physics(task, backend=backend).dt == times[backend]


@each_task
def test_geoms_do_not_leak_the_engine(task, program):
    geoms = program(task).physics.geoms
    for value in (*geoms.kind, *geoms.link, *geoms.material):
        assert type(value) is int
    assert all(type(name) is str for name in geoms.name)
    assert {leaf.dtype for leaf in jax.tree.leaves(geoms)} == {np.dtype(np.float32)}
    number = len(geoms.kind)
    assert geoms.size.shape == geoms.pos.shape == (number, 3)
    assert geoms.quat.shape == (number, 4)
    assert set(geoms.material) == set(range(len(geoms.rgb)))
    hash((geoms.kind, geoms.link, geoms.material, geoms.name))


def test_equal_calls_give_equal_physics():
    one, two = make_physics("reacher"), make_physics("reacher")
    assert one == two
    assert hash(one) == hash(two)
    assert one != make_physics("reacher", backend="spring")
    assert jax.tree.structure(one.geoms) == jax.tree.structure(two.geoms)
    jax.tree.map(np.testing.assert_array_equal, one.geoms, two.geoms)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"task": "antt"},
            r"unknown task: 'antt'\. Did you mean 'ant'\? Allowed: ant, .*, halfcheetah, .*\.$",
        ),
        ({"task": "Walker2d"}, "Did you mean 'walker2d'?"),
        ({"task": None}, "unknown task: None; allowed: ant"),
        (
            {"task": "ant", "backend": "sprng"},
            r"unknown backend of task 'ant': 'sprng'\. Did you mean 'spring'\? "
            r"Allowed: generalized, mjx, spring\.",
        ),
        (
            {"task": "swimmer", "backend": "mjx"},
            "unknown backend of task 'swimmer': 'mjx'; allowed: generalized",
        ),
        (
            {"task": "ant", "reward_preset": "papr"},
            r"unknown reward_preset: 'papr'\. Did you mean 'paper'\? Allowed: brax, paper\.",
        ),
    ],
)
def test_unknown_names(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_physics(**arguments)


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
    visible = model.geom_rgba[:, 3] > 0
    unnamed = [i for i in range(model.ngeom) if not model.geom(i).name and visible[i]]
    for index, name in enumerate(physics.geoms.name):
        original = named[name] if name in named else unnamed.pop(0)
        pos, mat = geom_pose(physics.geoms, state, index)
        expected = data.geom_xmat[original].reshape(3, 3)
        np.testing.assert_allclose(pos, data.geom_xpos[original], atol=2e-5, err_msg=name)
        np.testing.assert_allclose(mat, expected, atol=2e-5, err_msg=name)
        assert physics.geoms.kind[index] == model.geom_type[original]
        used, real = np.asarray(physics.geoms.size[index]), model.geom_size[original]
        if name in ENLARGED:
            assert used[0] > real[0]
        else:
            np.testing.assert_allclose(used[used > 0], real[used > 0], rtol=1e-6)
        assert used[0] > 0
    assert not unnamed


@each_task
def test_a_reset_is_a_reproducible_unit_pose(task, program, unfused_model, geom_pose):
    compiled, model = program(task), unfused_model(task)
    physics, state = compiled.physics, compiled.reset(jax.random.key(7))
    check_poses(model, physics, state, geom_pose)

    np.testing.assert_allclose(np.linalg.norm(state.xquat, axis=-1), 1, atol=1e-6)
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        start = model.jnt_qposadr[joint] + 3
        norm = np.linalg.norm(state.engine.pipeline.q[start : start + 4])
        np.testing.assert_allclose(norm, 1, atol=1e-6)
        # The free joint's x and y are left out, so its quaternion is observed at 1 to 4.
        np.testing.assert_allclose(np.linalg.norm(state.obs[1:5]), 1, atol=1e-6)

    links = len(physics.link_names)
    shapes = {"xpos": (links, 3), "xquat": (links, 4), "obs": (physics.state_size,), "reward": ()}
    for name, shape in shapes.items():
        assert getattr(state, name).shape == shape
        assert getattr(state, name).dtype == np.float32
    for flag in (state.terminated, state.non_finite):
        assert (flag.shape, flag.dtype, bool(flag)) == ((), bool, False)
    assert state.reward == 0

    jax.tree.map(np.testing.assert_array_equal, state, compiled.reset(jax.random.key(7)))
    other = compiled.reset(jax.random.key(8))
    assert not np.array_equal(state.obs, other.obs)
    assert not np.array_equal(state.xpos, other.xpos)


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


# How far links may come apart, metres: Brax's maximal engines hold joints by springs or
# corrections, the others not at all loosely.
LOOSENESS = {"generalized": 1e-4, "mjx": 1e-3, "positional": 0.05, "spring": 0.1}
# MJX is slow on the pusher: its solver seems not to converge in float32 and to take all 20 x 50
# iterations.
STEPS = {("pusher", "mjx"): 10}
each_backend = pytest.mark.parametrize(
    ("task", "backend"), [(row.name, name) for row in BRAX_TASKS.values() for name in row.backends]
)


@pytest.mark.slow
@each_backend
def test_200_random_steps(task, backend, unfused_model):
    physics = make_physics(task, backend=backend)
    steps = STEPS.get((task, backend), 200)

    def rollout(key):
        reset_key, action_key = jax.random.split(key)
        actions = jax.random.uniform(action_key, (steps, physics.action_size), minval=-1, maxval=1)

        def step(state, action):
            state = physics.step(state, action)
            return state, (state, state.engine.pipeline.q, state.engine.pipeline.qd)

        return jax.lax.scan(step, physics.reset(reset_key), actions)[1]

    options = {"xla_backend_optimization_level": 0}
    keys = jax.random.split(jax.random.key(1), 2)
    states, q, qd = jax.jit(jax.vmap(rollout), compiler_options=options)(keys)
    q, qd = np.asarray(q), np.asarray(qd)
    for field in ("xpos", "xquat", "obs", "reward"):
        assert np.isfinite(getattr(states, field)).all(), field
    np.testing.assert_allclose(np.linalg.norm(states.xquat, axis=-1), 1, atol=1e-5)

    model = unfused_model(task)
    data = mujoco.MjData(model)
    moving = np.flatnonzero(model.body_jntnum)
    terminated = np.asarray(states.terminated)
    for env in range(2):
        # What comes after the end of an episode is never seen.
        length = int(terminated[env].argmax()) if terminated[env].any() else steps
        assert length > 0, "the episode ended in its first step"
        assert not states.non_finite[env, :length].any()
        assert np.abs(states.reward[env, :length]).max() < 50
        assert np.abs(states.xpos[env, :length]).max() < 20
        # It moves.
        assert np.abs(states.xpos[env, 0] - states.xpos[env, length - 1]).max() > 1e-4
        for moment in range(0, length, 20):
            data.qpos[:] = q[env, moment]
            if backend == "mjx":
                # As in MuJoCo, poses are from before the last integration of the joints.
                velocity = qd[env, moment].astype(float)
                mujoco.mj_integratePos(model, data.qpos, velocity, -model.opt.timestep)
            mujoco.mj_kinematics(model, data)
            apart = np.abs(np.asarray(states.xpos[env, moment]) - data.xpos[moving]).max()
            assert apart < LOOSENESS[backend], (moment, apart)


@pytest.mark.slow
@pytest.mark.parametrize("backend", sorted(set(BACKENDS) - {"generalized"}))
def test_brax_still_refuses_the_swimmer_elsewhere(backend):
    with pytest.raises(ValueError, match="Unsupported backend"):
        load_brax_env("swimmer", backend)


@pytest.mark.parametrize(
    ("task", "backend"),
    [
        pytest.param(row.name, name, marks=() if name == row.default_backend else pytest.mark.slow)
        for row in BRAX_TASKS.values()
        for name in row.backends
    ],
)
def test_step_is_traced_once(task, backend):
    """Python numbers and weak types in Brax's state do not leak into ours."""
    physics = make_physics(task, backend=backend)
    first = jax.eval_shape(physics.reset, jax.random.key(0))
    after = jax.eval_shape(physics.step, first, jnp.zeros(physics.action_size))
    assert jax.tree.structure(first) == jax.tree.structure(after)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(after), strict=True):
        assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type)
