"""Rewards and terminations, recomputed in NumPy from the poses before and after a step."""

import jax
import numpy as np
import pytest

from pixelbrax_jax.tasks import BRAX_TASKS


def step_once(program, task, preset="brax", backend=None, scale=1.0):
    """States before and after one step (from one that is itself no reset), and the action."""
    compiled = program(task, backend, preset)
    # The presets share their resets; one program serves both.
    state = program(task, backend).reset(jax.random.key(3))
    actions = jax.random.uniform(
        jax.random.key(4), (2, compiled.physics.action_size), minval=-scale, maxval=scale
    )
    before = compiled.step(state, actions[0])
    return compiled.physics, before, compiled.step(before, actions[1]), np.asarray(actions[1])


def x_velocity(physics, before, after):
    return float(after.xpos[0, 0] - before.xpos[0, 0]) / physics.dt


def cost(action):
    return float(np.sum(np.square(action, dtype=np.float64)))


def joints(state):
    return np.asarray(state.engine.pipeline.q, np.float64)


@pytest.mark.parametrize(("preset", "weight"), [("brax", 1), ("paper", 10)])
def test_walker2d(preset, weight, program):
    physics, before, after, action = step_once(program, "walker2d", preset)
    expected = weight * x_velocity(physics, before, after) + 1 - 1e-3 * cost(action)
    np.testing.assert_allclose(after.reward, expected, atol=1e-4 * weight)


def test_swimmer_of_brax(program):
    physics, before, after, action = step_once(program, "swimmer")
    velocity = (joints(after)[0] - joints(before)[0]) / physics.dt
    np.testing.assert_allclose(after.reward, velocity - 1e-4 * cost(action), atol=1e-4)


def test_swimmer_of_the_paper(program):
    _, _, after, action = step_once(program, "swimmer", "paper")
    expected = np.hypot(*joints(after)[:2]) - 1e-9 * cost(action)
    np.testing.assert_allclose(after.reward, expected, rtol=1e-5)
    assert after.reward > 0


def test_reacher(program, geom_pose):
    physics, _, after, action = step_once(program, "reacher")
    tip, target = (
        geom_pose(physics.geoms, after, physics.geoms.name.index(name))[0]
        for name in ("fingertip", "target")
    )
    expected = -np.linalg.norm(tip - target) - cost(action)
    np.testing.assert_allclose(after.reward, expected, atol=1e-5)


def test_inverted_pendulum_pays_one_and_falls_at_a_fifth_of_a_radian(program):
    compiled = program("inverted_pendulum")
    for angle, falls in ((0.19, False), (-0.19, False), (0.21, True), (-0.21, True)):
        state = compiled.from_qpos(np.array([0, angle], np.float32))
        after = compiled.step(state, np.zeros(1, np.float32))
        # The step moves the pole a little further.
        assert abs(float(after.obs[1]) - angle) < 0.01
        assert bool(after.terminated) == falls
        assert after.reward == 1
        assert not after.non_finite


def test_actions_of_the_paper_are_not_rescaled(program):
    """Brax's pendulum triples an action; the paper's takes it as it is."""
    brax, paper = program("inverted_pendulum"), program("inverted_pendulum", None, "paper")
    state = brax.reset(jax.random.key(5))
    action = np.array([0.6], np.float32)
    for leaf, same, other in zip(
        *map(jax.tree.leaves, (
            paper.step(state, action).obs,
            brax.step(state, action / 3).obs,
            brax.step(state, action).obs,
        )),
        strict=True,
    ):  # fmt: skip
        np.testing.assert_allclose(leaf, same, atol=1e-5)
        assert np.abs(leaf - other).max() > 1e-2


@pytest.mark.slow
@pytest.mark.parametrize(("task", "weight"), [("ant", 0.5), ("halfcheetah", 0.1), ("hopper", 1e-3)])
@pytest.mark.parametrize("preset", ["brax", "paper"])
def test_runners(task, weight, preset, program):
    physics, before, after, action = step_once(program, task, preset)
    alive = 0 if task == "halfcheetah" else 1
    expected = x_velocity(physics, before, after) + alive - weight * cost(action)
    np.testing.assert_allclose(after.reward, expected, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "scale"), [("brax", 0.4), ("paper", 1)])
def test_humanoid(preset, scale, program):
    physics, before, after, action = step_once(program, "humanoid", preset)
    # The center of mass by Brax's own inertias. In its maximal engines a link weighs its mass to
    # the power 1 - spring_mass_scale.
    system = physics._env.sys
    mass = np.asarray(system.link.inertia.mass, np.float64) ** (1 - system.spring_mass_scale)
    offset = np.asarray(system.link.inertia.transform.pos, np.float64)

    def center_of_mass(state):
        points = [link_point(state, i, offset[i]) for i in range(len(mass))]
        return np.average(points, axis=0, weights=mass)

    forward = (center_of_mass(after) - center_of_mass(before))[0] / physics.dt
    expected = 1.25 * forward + 5 - 0.1 * scale**2 * cost(action)
    np.testing.assert_allclose(after.reward, expected, atol=2e-3)


def center(model, state, link):
    """Center of mass of a link."""
    return link_point(state, link, model.body_ipos[1 + link])


def link_point(state, link, point):
    quat = np.asarray(state.xquat[link], np.float64)
    w, axis = quat[0], quat[1:]
    twice = 2 * np.cross(axis, point)
    return np.asarray(state.xpos[link], np.float64) + point + w * twice + np.cross(axis, twice)


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "scale"), [("brax", 0.4), ("paper", 1)])
def test_humanoidstandup(preset, scale, program):
    physics, _, after, action = step_once(program, "humanoidstandup", preset)
    expected = float(after.xpos[0, 2]) / physics.dt + 1 - 0.01 * scale**2 * cost(action)
    np.testing.assert_allclose(after.reward, expected, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "scale"), [("brax", 2), ("paper", 1)])
def test_pusher(preset, scale, program):
    # Brax measures the distances before the step, from the links' centers of mass.
    physics, before, after, action = step_once(program, "pusher", preset)
    model = physics._model
    tip, thing, goal = (
        center(model, before, physics.link_names.index(name))
        for name in ("r_wrist_flex_link", "object", "goal")
    )
    expected = (
        -np.linalg.norm(thing - goal)
        - 0.1 * scale**2 * cost(action)
        - 0.5 * np.linalg.norm(thing - tip)
    )
    np.testing.assert_allclose(after.reward, expected, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["ant", "reacher", "inverted_double_pendulum"])
def test_tasks_that_the_paper_leaves_alone(task, program):
    _, _, brax, _ = step_once(program, task, "brax")
    _, _, paper, _ = step_once(program, task, "paper")
    np.testing.assert_array_equal(brax.reward, paper.reward)


def test_every_paper_setting_belongs_to_a_task_that_differs():
    changed = {
        name
        for name, spec in BRAX_TASKS.items()
        if spec.paper_options or spec.paper_unscaled or spec.paper_reward
    }
    unscaled = {"humanoid", "humanoidstandup", "inverted_pendulum", "pusher"}
    assert changed == unscaled | {"swimmer", "walker2d"}


PENDULUM = "inverted_double_pendulum"
# (cart, first hinge, second hinge) -> tip (x, z); agrees with MuJoCo's site "tip".
TIPS = [
    ((0, 0, 0), (0, 1.2)),
    ((0, 0, np.pi / 2), (0.6, 0.6)),
    ((0, 0, np.pi), (0, 0)),
    ((0, 0.3, -0.3), (0.1773, 1.1732)),
    ((0.2, 0.5, 0.7), (1.0469, 0.7440)),
]
backends = pytest.mark.parametrize(
    "backend",
    [
        pytest.param(name, marks=() if name == "generalized" else pytest.mark.slow)
        for name in BRAX_TASKS[PENDULUM].backends
    ],
)


def tip_of(physics, state, geom_pose):
    """Center of the far end cap of the upper pole, as an image shows it."""
    index = physics.geoms.name.index("cpole2")
    pos, mat = geom_pose(physics.geoms, state, index)
    half = float(physics.geoms.size[index, 1])
    ends = [pos + mat[:, 2] * half, pos - mat[:, 2] * half]
    hinge = np.asarray(state.xpos[physics.link_names.index("pole2")])
    return max(ends, key=lambda end: np.linalg.norm(end - hinge))


@backends
def test_tip(backend, program, geom_pose):
    compiled = program(PENDULUM, backend)
    for q, (x, z) in TIPS:
        state = compiled.from_qpos(np.array(q, np.float32))
        tip = tip_of(compiled.physics, state, geom_pose)
        np.testing.assert_allclose(tip, [x, 0, z], atol=1e-4, err_msg=str(q))


@backends
def test_fallen_upper_pole_ends_the_episode_without_a_bonus(backend, program, geom_pose):
    compiled = program(PENDULUM, backend)
    fallen = compiled.from_qpos(np.array([0, 0, np.pi / 2], np.float32))
    assert not fallen.terminated
    state = compiled.step(fallen, np.zeros(1, np.float32))
    assert state.terminated
    assert not state.non_finite
    assert state.reward < 0
    np.testing.assert_allclose(
        state.reward, pendulum_reward(compiled.physics, state, geom_pose, alive=0), atol=1e-4
    )


@backends
def test_upright_pole_earns_the_bonus(backend, program, geom_pose):
    compiled = program(PENDULUM, backend)
    upright = compiled.from_qpos(np.array([0, 0.01, 0.02], np.float32))
    state = compiled.step(upright, np.full(1, 0.1, np.float32))
    assert not state.terminated
    np.testing.assert_allclose(
        state.reward, pendulum_reward(compiled.physics, state, geom_pose, alive=10), atol=1e-4
    )


def pendulum_reward(physics, state, geom_pose, alive):
    x, _, z = tip_of(physics, state, geom_pose)
    _, v1, v2 = np.asarray(state.engine.pipeline.qd)
    return alive - (0.01 * x**2 + (z - 2) ** 2) - (1e-3 * v1**2 + 5e-3 * v2**2)
