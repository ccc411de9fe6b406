"""Rewards and terminations, recomputed in NumPy from the poses before and after a step."""

from functools import partial

import jax
import numpy as np
import pytest

from pixelbrax_jax.tasks import BRAX_TASKS
from tests.physics.conftest import rotation_matrix


def step_once(program, task, preset="brax"):
    """States before and after one step (from one that is itself no reset), and the action."""
    compiled = program(task, None, preset)
    # The presets share their resets; one program serves both.
    state = program(task).reset(jax.random.key(3))
    actions = jax.random.uniform(
        jax.random.key(4), (2, compiled.physics.action_size), minval=-1.0, maxval=1.0
    )
    before = compiled.step(state, actions[0])
    return compiled.physics, before, compiled.step(before, actions[1]), np.asarray(actions[1])


def x_velocity(physics, before, after):
    return float(after.xpos[0, 0] - before.xpos[0, 0]) / physics.dt


def cost(action):
    return float(np.sum(np.square(action, dtype=np.float64)))


def joints(state):
    return np.asarray(state.engine.pipeline.q, np.float64)


def runner(physics, before, after, action, speed, alive, control):
    return speed * x_velocity(physics, before, after) + alive - control * cost(action)


def swimmer(physics, before, after, action):
    return (joints(after)[0] - joints(before)[0]) / physics.dt - 1e-4 * cost(action)


def swimmer_of_the_paper(physics, before, after, action):
    return np.hypot(*joints(after)[:2]) - 1e-9 * cost(action)


def humanoid(physics, before, after, action, scale):
    # The center of mass by Brax's own inertias. In its maximal engines a link weighs its mass to
    # the power 1 - spring_mass_scale.
    system = physics._env.sys
    mass = np.asarray(system.link.inertia.mass, np.float64) ** (1 - system.spring_mass_scale)
    offset = np.asarray(system.link.inertia.transform.pos, np.float64)

    def center_of_mass(state):
        points = [link_point(state, i, offset[i]) for i in range(len(mass))]
        return np.average(points, axis=0, weights=mass)

    forward = (center_of_mass(after) - center_of_mass(before))[0] / physics.dt
    return 1.25 * forward + 5 - 0.1 * scale**2 * cost(action)


def humanoidstandup(physics, before, after, action, scale):
    return float(after.xpos[0, 2]) / physics.dt + 1 - 0.01 * scale**2 * cost(action)


def pusher(physics, before, after, action, scale):
    # Brax measures the distances before the step, from the links' centers of mass.
    links = [physics.link_names.index(n) for n in ("r_wrist_flex_link", "object", "goal")]
    offsets = physics._model.body_ipos[1:]
    tip, thing, goal = (link_point(before, link, offsets[link]) for link in links)
    near, far = np.linalg.norm(thing - goal), np.linalg.norm(thing - tip)
    return -near - 0.1 * scale**2 * cost(action) - 0.5 * far


def link_point(state, link, point):
    return np.asarray(state.xpos[link], np.float64) + rotation_matrix(state.xquat[link]) @ point


FORMULAS = [
    ("walker2d", "brax", partial(runner, speed=1, alive=1, control=1e-3), 1e-4),
    ("walker2d", "paper", partial(runner, speed=10, alive=1, control=1e-3), 1e-3),
    ("swimmer", "brax", swimmer, 1e-4),
    ("swimmer", "paper", swimmer_of_the_paper, 1e-6),
    ("ant", "brax", partial(runner, speed=1, alive=1, control=0.5), 1e-4),
    ("halfcheetah", "brax", partial(runner, speed=1, alive=0, control=0.1), 1e-4),
    ("hopper", "brax", partial(runner, speed=1, alive=1, control=1e-3), 1e-4),
    ("humanoid", "brax", partial(humanoid, scale=0.4), 2e-3),
    ("humanoid", "paper", partial(humanoid, scale=1), 2e-3),
    ("humanoidstandup", "brax", partial(humanoidstandup, scale=0.4), 1e-4),
    ("humanoidstandup", "paper", partial(humanoidstandup, scale=1), 1e-4),
    ("pusher", "brax", partial(pusher, scale=2), 1e-4),
    ("pusher", "paper", partial(pusher, scale=1), 1e-4),
]


@pytest.mark.parametrize(
    ("task", "preset", "expected", "tolerance"),
    [
        pytest.param(*row, marks=() if row[0] in ("walker2d", "swimmer") else pytest.mark.slow)
        for row in FORMULAS
    ],
)
def test_formulas(task, preset, expected, tolerance, program):
    physics, before, after, action = step_once(program, task, preset)
    wanted = expected(physics, before, after, action)
    np.testing.assert_allclose(after.reward, wanted, atol=tolerance)


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
    obs = paper.step(state, action).obs
    np.testing.assert_allclose(obs, brax.step(state, action / 3).obs, atol=1e-5)
    assert np.abs(obs - brax.step(state, action).obs).max() > 1e-2


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
@pytest.mark.parametrize(
    ("q", "action", "alive"), [((0, 0, np.pi / 2), 0.0, 0), ((0, 0.01, 0.02), 0.1, 10)]
)
def test_a_fallen_upper_pole_ends_the_episode_without_a_bonus(
    q, action, alive, backend, program, geom_pose
):
    compiled = program(PENDULUM, backend)
    first = compiled.from_qpos(np.array(q, np.float32))
    assert not first.terminated
    state = compiled.step(first, np.full(1, action, np.float32))
    assert bool(state.terminated) == (alive == 0)
    assert not state.non_finite
    expected = pendulum_reward(compiled.physics, state, geom_pose, alive)
    np.testing.assert_allclose(state.reward, expected, atol=1e-4)


def pendulum_reward(physics, state, geom_pose, alive):
    x, _, z = tip_of(physics, state, geom_pose)
    _, v1, v2 = np.asarray(state.engine.pipeline.qd)
    return alive - (0.01 * x**2 + (z - 2) ** 2) - (1e-3 * v1**2 + 5e-3 * v2**2)
