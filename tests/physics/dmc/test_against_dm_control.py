"""Our tasks of the DM Control Suite do what DM Control's do, which is asked itself."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pixelbrax_jax.physics.dmc import models
from pixelbrax_jax.physics.dmc.domains import FORMULAS
from pixelbrax_jax.physics.mujoco.native import compile_model
from pixelbrax_jax.registry import make_physics
from pixelbrax_jax.tasks import DMC_TASKS
from tests.physics.dmc import measure, oracle

FAST = ("dmc_ball_in_cup_catch", "dmc_cartpole_swingup", "dmc_reacher_easy")
"""Tasks that compile soon: one drawn with rejection, one integrated with Runge-Kutta."""

EACH = [
    pytest.param(task, marks=() if task in FAST else [pytest.mark.slow, pytest.mark.timeout(1800)])
    for task in DMC_TASKS
]

pytestmark = pytest.mark.usefixtures("dm_control")

COMPARED = {DMC_TASKS[name].domain for name in FAST}
OF_OTHER_DOMAINS = {row.domain: row.name for row in DMC_TASKS.values()}
"""Domain -> one of its tasks."""


def number_of_states(task: str) -> int:
    return 40 if task in FAST else measure.STATES


@pytest.mark.parametrize("task", EACH)
def test_the_same_state_has_the_same_observation_and_reward(task):
    errors = measure.same_state(task, number_of_states(task))
    # Rounding to float32 of states and constants.
    assert errors["reward"] < 1e-6
    assert errors["observation"] < 1e-5
    assert errors["links"] < 1e-5


@pytest.mark.parametrize(
    "task", [task for domain, task in OF_OTHER_DOMAINS.items() if domain not in COMPARED]
)
def test_a_few_control_steps_of_every_other_domain(task):
    check_control_step(task, 12, episodes=1, length=120)


@pytest.mark.parametrize("task", EACH)
def test_one_control_step(task):
    check_control_step(task, number_of_states(task))


def check_control_step(task, count, **episodes):
    errors = measure.control_step(task, count, **episodes)
    assert errors["reward"] < 1e-5, errors
    assert errors["velocity"] < 1e-3, errors


def test_a_step_is_a_move_and_a_look():
    """What is compared here in two programs is what environments compute in one."""
    physics = make_physics("dmc_pendulum_swingup")
    keys = jax.random.split(jax.random.key(0), 5)
    state = jax.jit(jax.vmap(physics.reset))(keys)
    action = jnp.linspace(-1, 1, 5)[:, None]
    after = jax.jit(jax.vmap(physics.step))(state, action)
    moved, sensors = jax.jit(jax.vmap(physics.move))(state.engine, action)
    looked = jax.jit(jax.vmap(physics.observe))(moved, sensors)
    close = partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6)
    jax.tree.map(close, after, looked)


@pytest.mark.parametrize("task", EACH)
def test_initial_states_have_the_same_distribution(task):
    episodes = measure.EPISODES
    first = measure.initial_states(task, episodes)
    low = [name for name, p in first.items() if not p > 0.01]
    if low:
        # One of a hundred is that low by chance; of another sample none may be.
        second = measure.initial_states(task, episodes, seed=1)
        assert {name: second[name] for name in low if not second[name] > 0.01} == {}


@pytest.mark.parametrize("task", DMC_TASKS)
def test_models_are_equal(task):
    """Also those that are generated: swimmers, the quadruped and the manipulator."""
    parts = FORMULAS[task]
    ours = compile_model(models.load_spec(DMC_TASKS[task].domain, **parts.options))
    parts.edit(ours)
    env = oracle.load(task)
    theirs = env.physics.model
    # Each reset puts the target elsewhere, and the first one resizes or hides it.
    names = ("body_pos", "body_quat", "geom_pos", "site_pos", "light_pos")
    places = {name: getattr(theirs, name).copy() for name in names}
    env.reset()
    added = set()
    if "max_contacts" in parts.options:  # a number more, for MuJoCo XLA alone
        added = {"names", "names_map", "name_numericadr"}
        added |= {"numeric_adr", "numeric_data", "numeric_size"}
    for name in set(dir(ours)) - added:
        value = getattr(ours, name)
        if isinstance(value, np.ndarray) and not name.startswith("_"):
            expected = places.get(name, getattr(theirs, name))
            np.testing.assert_array_equal(value, expected, err_msg=name)
    for option in ("timestep", "integrator", "cone", "disableflags", "density", "viscosity"):
        assert getattr(ours.opt, option) == getattr(theirs.opt, option), option


@pytest.mark.parametrize("task", DMC_TASKS)
def test_sizes_and_times(task):
    physics, env = make_physics(task), oracle.load(task)
    observation = oracle.flatten(env.reset().observation)
    assert physics.state_size == observation.size
    assert physics.action_size == env.action_spec().shape[0]
    assert physics.dt == pytest.approx(env.control_timestep())
    assert env._step_limit == pytest.approx(1000)
    low, high = (physics.control(jnp.full(physics.action_size, end)) for end in (-1.0, 1.0))
    np.testing.assert_allclose(low, env.action_spec().minimum, rtol=1e-6)
    np.testing.assert_allclose(high, env.action_spec().maximum, rtol=1e-6)


def drawn(task: str, count: int) -> np.ndarray:
    """(count, Q) joint positions of initial states."""
    start, dynamics = FORMULAS[task].start, make_physics(task).dynamics
    keys = jax.random.split(jax.random.key(0), count)
    return np.array(jax.jit(jax.vmap(lambda key: start(dynamics, key).qpos))(keys))


def number_of_contacts(model: mujoco.MjModel, qpos: np.ndarray) -> int:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return int(data.ncon)


@pytest.mark.parametrize(
    "task",
    [
        pytest.param(task, marks=() if task in FAST else pytest.mark.slow)
        for task in (
            "dmc_ball_in_cup_catch",
            "dmc_finger_spin",
            "dmc_humanoid_walk",
            "dmc_manipulator_bring_ball",
        )
    ],
)
def test_rejection_leaves_no_contact(task):
    model = make_physics(task)._model
    assert not any(number_of_contacts(model, qpos) for qpos in drawn(task, 200))


@pytest.mark.slow
def test_the_ball_starts_in_the_hand_at_the_target_or_anywhere():
    task = "dmc_manipulator_bring_ball"
    physics, draw = make_physics(task), FORMULAS[task].start
    keys = jax.random.split(jax.random.key(0), 500)
    first = jax.jit(jax.vmap(lambda key: draw(physics.dynamics, key)))(keys)
    first = jax.tree.map(np.asarray, first)
    model = physics._model
    data, number = mujoco.MjData(model), {"hand": 0, "target": 0, "anywhere": 0}
    for qpos, qvel, target in zip(first.qpos, first.qvel, first.target, strict=True):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        ball, grasp = data.body("ball"), data.site("grasp")
        near = {"hand": grasp.xpos, "target": target[:3]}
        apart = {name: np.abs((ball.xpos - place)[::2]).max() for name, place in near.items()}
        nearest = min(apart, key=apart.get)
        where = nearest if apart[nearest] < 1e-5 else "anywhere"
        number[where] += 1
        if where == "hand":
            # As MuJoCo's axes say: the ball lies turned by half a turn less the grasp's angle.
            direction = grasp.xmat.reshape(3, 3)[[0, 2], 0]
            angle = np.pi - np.arctan2(direction[1], direction[0])
            np.testing.assert_allclose(qpos[-1], angle, atol=1e-5)
        elif where == "target":
            turn = 2 * np.arctan2(target[5], target[3])
            assert np.cos(qpos[-1] - turn) > 1 - 1e-5
        else:
            assert qvel[model.joint("ball_x").dofadr[0]] != 0
    assert np.count_nonzero(np.delete(first.qvel, model.joint("ball_x").dofadr[0], axis=1)) == 0
    assert min(number.values()) > 5, number
    assert number["anywhere"] > 250, number


@pytest.mark.slow
def test_the_quadruped_is_as_low_as_whole_centimetres_allow():
    task = "dmc_quadruped_walk"
    model = make_physics(task)._model
    for qpos in drawn(task, 200):
        assert number_of_contacts(model, qpos) == 0
        qpos[2] -= 0.01
        assert number_of_contacts(model, qpos) > 0
