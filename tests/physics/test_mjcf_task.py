"""Tasks from MJCF files."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pixelbrax_jax.physics.base import Physics
from pixelbrax_jax.physics.mujoco.mjcf import mjcf_physics

# A cart with a leaning pole; the knob is a body without a joint, rotated by Euler angles.
CART = """
<mujoco>
  <option timestep="0.01"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom name="ground" type="plane" size="1 1 .1" pos="0 0 -1"/>
    <body name="cart">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <geom name="cart" type="box" size=".1 .1 .05"/>
      <body pos="0 0 .05" euler="0 20 0">
        <joint name="hinge" axis="0 1 0" damping=".1"/>
        <geom name="pole" type="capsule" fromto="0 0 0 0 0 .5" size=".02"/>
        <body name="knob" euler="90 0 30">
          <geom name="knob" type="cylinder" size=".05 .1" pos="0 .5 .1"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="slide" gear="10" ctrllimited="true" ctrlrange="-1 3"/>
    <motor name="turn" joint="hinge"/>
  </actuator>
</mujoco>
"""


def upright(before, after, action):
    rise = after.geom_pos("pole")[2] - before.geom_pos("pole")[2]
    return rise - jnp.sum(action**2)


def build(source=CART, **changes):
    options = {"reward": upright, "n_frames": 2} | changes
    return mjcf_physics(source, **options)


@pytest.fixture(scope="module")
def cart(compiled):
    return compiled(build(terminated=lambda s: jnp.abs(s.qpos[1]) > 1.0, reset_noise=0.05))


def test_facts(cart):
    physics = cart.physics
    assert isinstance(physics, Physics)
    assert physics.dt == 0.02
    assert physics.action_size == 2
    assert physics.state_size == 4
    assert physics.link_names == ("cart", "link/1", "knob")
    assert physics.geoms.name == ("ground", "cart", "pole", "knob")
    assert physics.geoms.link == (-1, 0, 1, 2)


def test_poses_are_mujocos(cart, geom_pose):
    model = mujoco.MjModel.from_xml_string(CART)
    data = mujoco.MjData(model)
    state = cart.reset(jax.random.key(0))
    data.qpos[:] = state.engine.qpos
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(state.xpos, data.xpos[1:], atol=1e-6)
    for index in range(4):
        pos, mat = geom_pose(cart.physics.geoms, state, index)
        np.testing.assert_allclose(pos, data.geom_xpos[index], atol=1e-5)
        np.testing.assert_allclose(mat, data.geom_xmat[index].reshape(3, 3), atol=1e-5)


def test_reset_noise(cart):
    states = [cart.reset(jax.random.key(i)) for i in range(20)]
    noise = np.array([s.obs for s in states])
    assert np.abs(noise).max() <= 0.05
    assert np.abs(noise).max() > 0.04
    assert len(np.unique(noise)) == noise.size


def test_formulas(cart):
    before = cart.reset(jax.random.key(0))
    action = np.array([0.5, -0.25], np.float32)
    after = cart.step(before, action)
    model = mujoco.MjModel.from_xml_string(CART)
    data = mujoco.MjData(model)
    data.qpos, data.qvel, data.ctrl = before.engine.qpos, before.engine.qvel, [-1 + 4 * 0.75, -0.25]
    mujoco.mj_forward(model, data)
    height = data.geom("pole").xpos[2]
    mujoco.mj_step(model, data, 2)
    np.testing.assert_allclose(after.obs, np.concatenate([data.qpos, data.qvel]), atol=1e-6)
    mujoco.mj_forward(model, data)
    expected = data.geom("pole").xpos[2] - height - np.sum(action**2)
    np.testing.assert_allclose(after.reward, expected, atol=1e-6)
    assert not after.terminated
    leaning = cart.from_qpos(np.array([0, 1.1], np.float32))
    assert cart.step(leaning, action).terminated


def test_sensors_that_are_disabled_read_0_and_poses_do_not(compiled):
    """Nor is a sensor's reading another's, with names or without."""
    sensors = '<sensor><jointpos joint="slide"/><jointpos joint="hinge" name="pos"/></sensor>'

    def angles(seen):
        kind = mujoco.mjtSensor.mjSENS_JOINTPOS
        return jnp.concatenate([seen.sensor("pos"), seen.sensors_of(kind), seen.xpos("knob")])

    with_sensors = CART.replace("</mujoco>", f"{sensors}</mujoco>")
    off = '<option timestep="0.01"><flag sensor="disable"/></option>'
    without = with_sensors.replace('<option timestep="0.01"/>', off)
    there, here = (
        compiled(build(xml, observe=angles)).from_qpos(np.array([0.3, 0.4], np.float32))
        for xml in (with_sensors, without)
    )
    np.testing.assert_allclose(there.obs[:3], [0.4, 0.3, 0.4], atol=1e-6)
    np.testing.assert_array_equal(here.obs[:3], 0)
    np.testing.assert_array_equal(here.xpos, there.xpos)
    np.testing.assert_array_equal(here.obs[3:], there.obs[3:])
    assert np.abs(here.xpos[2]).max() > 0.1


def test_any_name_of_a_body_can_be_used():
    names = [*build(CART.replace('"cart">', '"body/2">', 1)).link_names]
    assert names == ["body/2", "link/1", "knob"]


def test_a_camera_of_a_body_without_mass_follows_the_body(compiled):
    camera = '<body name="tip" pos="0 0 .7"><camera name="c" mode="trackcom"/></body>'
    xml = CART.replace('<body name="knob"', f'{camera}<body name="knob"')
    physics = build(xml)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos = 0.3, 0.4
    mujoco.mj_forward(model, data)
    state = compiled(physics).from_qpos(np.array([0.3, 0.4], np.float32))
    com = state.xpos[physics.link_names.index("camera/com")]
    np.testing.assert_allclose(com, data.subtree_com[model.body("tip").id], atol=1e-6)


def test_file_that_includes_another(tmp_path):
    (tmp_path / "cart.xml").write_text(CART)
    (tmp_path / "scene.xml").write_text('<mujoco><include file="cart.xml"/></mujoco>')
    physics = build(tmp_path / "scene.xml", colors={"pole": (0, 1, 0)}, init_q=[0.5, 0])
    assert "pole" in physics.geoms.name
    assert jax.eval_shape(physics.reset, jax.random.key(0)).xpos.shape == (3, 3)


def test_own_observation():
    physics = build(observe=lambda s: jnp.concatenate([s.xpos("knob"), s.xquat("knob")]))
    assert physics.state_size == 7


def test_start_and_every_feature_of_mujoco(compiled):
    """A keyframe, a ball joint, a tendon and an equality constraint."""
    xml = """
    <mujoco>
      <worldbody>
        <body name="top"><joint name="ball" type="ball"/><geom size=".1" pos="0 0 -.3"/></body>
        <body name="bob"><joint name="x" type="slide"/><geom size=".1"/></body>
        <body name="twin"><joint name="y" type="slide"/><geom size=".1"/></body>
      </worldbody>
      <tendon><fixed name="pull"><joint joint="x" coef="2"/></fixed></tendon>
      <equality><joint joint1="x" joint2="y"/></equality>
      <actuator><motor tendon="pull"/></actuator>
      <sensor><accelerometer site="seat"/></sensor>
      <keyframe><key qpos="0 0 3 4 1 2"/></keyframe>
    </mujoco>
    """.replace('<geom size=".1"/></body>', '<geom size=".1"/><site name="seat"/></body>', 1)

    def forces(seen):
        return jnp.concatenate([seen.qpos, seen.data.sensordata])

    physics = mjcf_physics(xml, reward=lambda *_: jnp.zeros(()), reset_noise=0.0, observe=forces)
    assert physics.action_size == 1
    program = compiled(physics)
    state = program.reset(jax.random.key(0))
    np.testing.assert_allclose(state.obs[:6], [0, 0, 0.6, 0.8, 1, 2], atol=1e-6)
    after = program.step(state, np.ones(1, np.float32))
    assert not after.non_finite
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos, data.ctrl = state.engine.qpos, 1
    mujoco.mj_step(model, data, 5)
    np.testing.assert_allclose(after.obs, [*data.qpos, *data.sensordata], atol=1e-5)


def test_missing_file(tmp_path):
    for path in (tmp_path / "arm.xml", "arm.xml", "a" * 9999 + "arm.xml"):
        with pytest.raises(FileNotFoundError, match=r"there is no MJCF file '/.*arm\.xml'"):
            build(path)
    with pytest.raises(FileNotFoundError, match=r"'; XML itself begins with '<'\.$"):
        build("")


def test_file_in_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "cart.xml").write_text(CART)
    assert build("~/cart.xml").action_size == 2


def test_meshes_are_convex_hulls():
    mesh = """<asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>
    <worldbody><geom name="statue" type="mesh" mesh="m"/>"""
    physics = build(CART.replace("<worldbody>", mesh))
    assert physics.geoms.num_planes[physics.geoms.name.index("statue")] == 4
    assert physics.hull_errors == {"statue": 0.0}


HILLS = """<asset><hfield name="h" nrow="3" ncol="3" size="1 1 1 1"/></asset>
<worldbody><geom name="hills" type="hfield" hfield="h"/>"""


@pytest.mark.parametrize(
    ("xml", "message"),
    [
        ("<mujoco><wrldbody/></mujoco>", r"MuJoCo cannot compile the given XML: (.|\n)*wrldbody"),
        (CART[: CART.index("<actuator>")] + "</mujoco>", "the model has no actuator"),
        ('<mujoco><worldbody><geom size=".1"/></worldbody></mujoco>', "the model has no joint"),
        (
            CART.replace("</mujoco>", '<sensor><clock name="now"/><clock/></sensor></mujoco>'),
            "sensor 'now', 'sensor/1' is a clock, and states have no time: remove it",
        ),
        (CART.replace("<worldbody>", HILLS), "cannot be rendered: hfield 'hills'"),
    ],
)
def test_models_that_are_no_task(xml, message):
    with pytest.raises(ValueError, match=message):
        build(xml)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"reward": lambda b, a, u: a.qpos},
            r"reward must return a scalar number, got shape \(2,\)",
        ),
        ({"reward": lambda b, a, u: a.qpos[0] > 0}, "reward must return a scalar number, .* bool"),
        ({"reward": lambda b, a, u: None}, "reward must return a scalar number, got None"),
        ({"terminated": lambda a: a.qpos[0]}, "terminated must return a scalar bool, .* float32"),
        ({"terminated": lambda a: a.qpos > 0}, r"terminated must return a scalar bool, .* \(2,\)"),
        ({"observe": lambda a: a.data.xpos}, "observe must return a flat float array"),
        ({"observe": lambda a: a.qpos[:0]}, "observe must return a flat float array"),
        ({"init_q": np.zeros(3)}, r"init_q must have finite numbers of shape \(2,\), got array"),
        ({"init_q": ["a", "b"]}, r"init_q must have finite numbers of shape \(2,\), got \['a'"),
        ({"init_q": [0.0, -1e12]}, r"init_q must lie between -1e\+10 and 1e\+10, got \[0.0, -1"),
        ({"n_frames": 0}, "n_frames must be a positive integer, got 0"),
        ({"n_frames": 1.5}, "n_frames must be a positive integer, got 1.5"),
        ({"reset_noise": -1.0}, "reset_noise must be a number of at least 0, got -1.0"),
        ({"reset_noise": float("nan")}, "reset_noise must be a number of at least 0, got nan"),
        ({"reset_noise": "small"}, "reset_noise must be a number of at least 0, got 'small'"),
        ({"engine": "mujco"}, "unknown engine: 'mujco'. Did you mean 'mujoco'"),
        ({"reset": lambda key: jnp.zeros(4)}, r"reset must return .* \(2,\) and velocities \(2,\)"),
        ({"reset": lambda key: (jnp.zeros(2), jnp.zeros(3))}, r"got \(\(2,\), \(3,\)\)"),
        (
            {"reset": lambda key: (jnp.zeros(2), jnp.zeros(2)), "reset_noise": 0.1},
            "reset samples the whole initial state: leave reset_noise and init_q out",
        ),
        ({"colors": {"pol": (1, 0, 0)}}, "unknown geom: 'pol'. Did you mean 'pole'"),
        ({"geom_groups": (5,)}, "no geom is visible"),
    ],
)
def test_bad_arguments(change, message):
    with pytest.raises(ValueError, match=message):
        build(**change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reward": lambda after, action: 0.0}, r"reward must be a .* \(before, after, action\)"),
        ({"observe": lambda: 0.0}, r"observe must be a function of \(snapshot\)"),
        ({"reset": lambda: None}, r"reset must be a function of \(key\)"),
        ({"terminated": 3}, "terminated must be a function, got 3"),
    ],
)
def test_functions_of_other_arguments(change, message):
    with pytest.raises(TypeError, match=message):
        build(**change)


@pytest.mark.parametrize(
    "groups", [1, "012", (0, 6), (0.5,), ["a"], [[0]], (True,), np.array([[0, 1]])]
)
def test_groups_are_mujocos(groups):
    with pytest.raises(ValueError, match="geom_groups must be a collection of MuJoCo's groups, 0"):
        build(geom_groups=groups)


@pytest.mark.parametrize(
    "start", [{"init_q": [0.0, np.nan]}, {"init_q": [0.0, 1e11]}, {"reset_noise": 1e30}]
)
def test_episodes_do_not_begin_diverged(start):
    (name,) = start
    with pytest.raises(ValueError, match=f"{name} must .*(finite|1e\\+10).*, got"):
        build(**start)


def test_a_keyframe_far_away_is_named():
    key = '<keyframe><key qpos="1e12 0"/></keyframe></mujoco>'
    with pytest.raises(ValueError, match="qpos of the model's first keyframe must lie between"):
        build(CART.replace("</mujoco>", key))


def test_what_is_rendered_opaque_is_named():
    pane = '<geom name="pane" type="box" size=".1 .1 .1" rgba="1 0 0 {}" group="{}"/>'
    fog = '<asset><material name="fog" rgba="1 1 1 .5"/></asset>'
    body = '<body name="cart">'
    model = CART.replace(body, body + pane.format(0.5, 0) + '<site material="fog"/>')
    model = model.replace("<worldbody>", fog + "<worldbody>")
    with pytest.warns(
        UserWarning, match=r"geom 'pane', site 0\. Give each .* \(0, 1, 2\)"
    ) as found:
        build(model)
    assert found[0].filename == __file__
    for alpha, group in ((0, 0), (1, 0), (0.5, 3)):
        # Warnings are errors.
        build(CART.replace(body, body + pane.format(alpha, group)))


def test_models_beyond_mujoco_xla():
    option = CART.replace('timestep="0.01"', 'timestep="0.01" solver="PGS"')
    physics = build(option)
    state = jax.eval_shape(physics.reset, jax.random.key(0))
    step = jax.jit(physics.step).trace(state, jnp.zeros(2))
    with pytest.raises(ValueError, match=r"MuJoCo XLA cannot simulate .*SOL_PGS.*engine='mujoco'"):
        step.lower(lowering_platforms=("cuda",))
    motor = CART.replace('<motor name="turn"', '<motor armature="1" name="turn"')
    with pytest.raises(ValueError, match=r"MuJoCo XLA does not simulate armature"):
        build(motor, engine="xla")
