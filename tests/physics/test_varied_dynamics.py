"""Friction, masses, damping, gains and gravity that vary between episodes."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import pixelbrax_jax as pb
from pixelbrax_jax.physics.mujoco.multipliers import MultipliedModels, multiplied
from pixelbrax_jax.ranges import MULTIPLIERS, as_arrays, check_ranges, sample

SLOPE = """
<mujoco>
  <option timestep=".01"/>
  <worldbody>
    <geom type="plane" size="0 0 1" euler="0 25 0"/>
    <body pos="0 0 .11">
      <freejoint/>
      <geom size=".1" condim="3" friction=".3"/>
    </body>
    <body pos="0 3 9">
      <joint name="hinge" axis="0 1 0" damping=".3"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
      <site name="tip" pos=".3 0 0"/>
    </body>
    <body pos="0 5 9">
      <joint name="slide" type="slide" axis="1 0 0" range="-1 1"/>
      <geom size=".1"/>
    </body>
  </worldbody>
  <tendon><fixed name="rope" damping=".2"><joint joint="slide" coef="1"/></fixed></tendon>
  <actuator>
    <motor joint="hinge" gear="2"/>
    <position joint="hinge" kp="3" kv=".1"/>
    <muscle tendon="rope" lengthrange="-1 1" force="5"/>
  </actuator>
  <sensor><accelerometer site="tip"/></sensor>
</mujoco>
"""
STEPS = 20


def zero(*_):
    return jnp.zeros(())


def in_mujoco(multipliers, action):
    """Positions, velocities and sensors after a control step of a changed model."""
    model = mujoco.MjModel.from_xml_string(SLOPE)
    model.geom_friction *= multipliers[0]
    model.body_mass *= multipliers[1]
    model.body_inertia *= multipliers[1]
    stiffness = model.body_invweight0.copy(), model.dof_invweight0.copy()
    mujoco.mj_setConst(model, mujoco.MjData(model))
    model.body_invweight0[:], model.dof_invweight0[:] = stiffness
    model.dof_damping *= multipliers[2]
    model.tendon_damping *= multipliers[2]
    model.actuator_gainprm[:2, :3] *= multipliers[3]
    model.actuator_biasprm[:2, :3] *= multipliers[3]
    for parameters in (model.actuator_gainprm, model.actuator_biasprm):
        parameters[2, 2:4] *= multipliers[3]
    model.opt.gravity *= multipliers[4]
    data = mujoco.MjData(model)
    data.ctrl[:] = action  # there are no ranges
    mujoco.mj_step(model, data, STEPS)
    return np.concatenate([data.qpos, data.qvel, data.sensordata])


def observe(seen):
    return jnp.concatenate([seen.qpos, seen.qvel, seen.data.sensordata])


@pytest.mark.parametrize("engine", ["mujoco", pytest.param("xla", marks=pytest.mark.slow)])
def test_a_step_is_that_of_the_changed_model(engine):
    """Ten frictions, and each other multiplier."""
    rows = np.ones((18, 5), np.float32)
    rows[:10, 0] = np.linspace(0.1, 2.0, 10)
    for column in range(1, 5):
        rows[8 + 2 * column : 10 + 2 * column, column] = 0.5, 1.7
    physics = pb.mjcf_physics(
        SLOPE, reward=zero, observe=observe, reset_noise=0.0, n_frames=STEPS, engine=engine
    )
    action = np.array([0.4, -0.6, 0.8], np.float32)

    def step(row):
        return physics.step(physics.reset(jax.random.key(0), row), action).obs

    options = {"xla_backend_optimization_level": 0}
    found = jax.jit(jax.vmap(step), compiler_options=options)(rows)
    expected = np.stack([in_mujoco(row, action) for row in rows])
    tolerance = {"mujoco": 2e-5, "xla": 2e-3}[engine]
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)
    assert len(np.unique(expected[:10, 0])) > 5, "friction matters"
    assert all(np.abs(row - expected[-1]).max() > 1e-3 for row in expected[10:17])


def test_every_field_that_changes_exists_in_both_kinds_of_models():
    mjx = pytest.importorskip("mujoco.mjx")
    model = mujoco.MjModel.from_xml_string(SLOPE)
    for kind in (model, mjx.put_model(model, impl="jax")):
        for name, value in multiplied(kind, np.full(5, 2.0)).items():
            owner = kind.opt if name.startswith("opt.") else kind
            assert np.shape(getattr(owner, name.removeprefix("opt."))) == np.shape(value)


def make(num_envs, **options):
    options = {"dynamics": {"friction": (0.5, 2), "gravity": (0.8, 1.2), "mass": 1.5}} | options
    env, params = pb.make("gym_hopper", obs_mode="state", **options)
    return pb.VectorPixelEnv(env, num_envs), params


def roll(num_envs, steps=6, **options):
    env, params = make(num_envs, **options)
    state, _ = env.reset(jax.random.key(1), params)
    timestep = None
    for _ in range(steps):
        state, timestep = env.step(state, jnp.full((num_envs, 3), 0.3), params)
    return state, timestep


def test_multipliers_are_drawn_for_each_episode():
    state, _ = roll(20, episode_length=4)
    rows = np.asarray(state.sim.physics.engine.multipliers)
    assert MULTIPLIERS == ("friction", "mass", "damping", "gain", "gravity")
    for column, (low, high) in enumerate([(0.5, 2), (1.5, 1.5), (1, 1), (1, 1), (0.8, 1.2)]):
        assert (low <= rows[:, column]).all()
        assert (rows[:, column] <= high).all()
        assert len(np.unique(rows[:, column])) == (20 if low < high else 1)
    state, _ = roll(20, steps=0)
    assert (rows[:, 0] != state.sim.physics.engine.multipliers[:, 0]).all()


def test_bits_do_not_depend_on_the_number_of_environments():
    few, many = roll(3), roll(20)
    for a, b in zip(jax.tree.leaves(few[1]), jax.tree.leaves(many[1]), strict=True):
        np.testing.assert_array_equal(a, b[:3])


def test_nothing_else_is_drawn_differently():
    """Of one multiplier, 1, the episode is that without any."""
    (_, plain), (_, same) = roll(3, dynamics=""), roll(3, dynamics={"gain": 1})
    np.testing.assert_allclose(plain.obs, same.obs, atol=1e-6)


def test_a_range_for_each_environment():
    env, params = make(2)
    rows = jnp.array([[0.5, 0.5], [2.0, 2.0]])
    params = params.replace(dynamics=params.dynamics.replace(gravity=rows))
    state, _ = env.reset(jax.random.key(1), params)
    np.testing.assert_array_equal(state.sim.physics.engine.multipliers[:, 4], [0.5, 2.0])


def test_texts_and_dictionaries_are_the_same():
    text = "friction=0.5:2.0,gravity=0.8"
    for same in (text, "gravity=.8, friction=.5:2", {"gravity": 0.8, "friction": (0.5, 2)}):
        assert check_ranges("dynamics", same) == text
    assert check_ranges("dynamics", {}) == ""
    drawn = sample(as_arrays(text), jax.random.key(0))
    assert drawn.dtype == jnp.float32
    assert list(drawn[1:4]) == [1, 1, 1]


@pytest.mark.parametrize(
    ("value", "error", "message"),
    [
        ({"weight": 1}, ValueError, "unknown multiplier in dynamics: 'weight'"),
        ("frictions=1", ValueError, "Did you mean 'friction'"),
        ({"mass": (2, 1)}, ValueError, r"dynamics of mass must be a positive .* got \(2, 1\)"),
        ("mass", ValueError, "positive number or two"),
        ("mass=1:2:3", ValueError, "positive number or two"),
        ("mass=0", ValueError, "positive number or two"),
        ({"mass": float("nan")}, ValueError, "positive number or two"),
        ({"mass": ()}, ValueError, "positive number or two"),
        ({"mass": "12"}, ValueError, "positive number or two"),
        ("mass=1,mass=2", ValueError, "dynamics must have each name once"),
        (3, TypeError, "dynamics must be a text such as 'friction=0.5:2,mass=1.2'"),
    ],
)
def test_bad_ranges(value, error, message):
    with pytest.raises(error, match=message):
        pb.EnvConfig(dynamics=value)


def test_tasks_that_cannot_vary():
    with pytest.raises(ValueError, match=r"dynamics='mass=2.0' is only for tasks that MuJoCo sim"):
        pb.make("ant", dynamics={"mass": 2})


def test_copies_of_models_are_made_once():
    model = mujoco.MjModel.from_xml_string(SLOPE)
    rows = np.ones((3, 5), np.float32)
    rows[1, 4] = 2
    models = MultipliedModels(model)
    first = list(models.of_rows(rows))
    rows[2, 4] = 3
    again = models.of_rows(rows[1:])
    assert [*again] == first[:2]
    np.testing.assert_allclose([m.opt.gravity[2] / model.opt.gravity[2] for m in again], [2, 3])
