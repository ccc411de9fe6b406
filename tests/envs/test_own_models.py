"""Models of the user's own as they are seen: goals, sites, cameras, chosen poses."""

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import pixelbrax_jax as pb
from pixelbrax_jax.physics.mujoco.geometry import site_shapes
from pixelbrax_jax.physics.mujoco.viewpoints import followed_body
from tests.envs.toy import Ball, limited

REACHER = """
<mujoco>
  <option timestep="0.01"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom name="table" type="plane" size="1 1 .1"/>
    <camera name="above" pos="0 0 1" xyaxes="1 0 0 0 1 0"/>
    <camera name="chase" pos="0 -1 1" xyaxes="1 0 0 0 1 1" mode="trackcom"/>
    <camera name="aim" pos="0 -1 1" mode="targetbody" target="arm"/>
    <camera name="flat" pos="0 0 1" projection="orthographic"/>
    <camera name="shifted" resolution="9 9" sensorsize="1 1" focal="1 1" principal=".1 0"/>
    <site name="start" pos="0 .3 .05" size=".01"/>
    <site name="hidden" pos="0 .3 .05" size=".01" group="3"/>
    <site name="clear" pos="0 .3 .05" size=".01" rgba="1 1 1 0"/>
    <body name="goal" pos="0 0 .05">
      <joint name="goal_x" type="slide" axis="1 0 0"/>
      <joint name="goal_y" type="slide" axis="0 1 0"/>
      <joint name="goal_z" type="slide" axis="0 0 1" armature="1000"/>
      <geom name="goal" size=".03" mass=".001" rgba=".8 .1 .1 1"/>
    </body>
    <body name="arm" pos="0 0 .05">
      <joint name="shoulder" axis="0 0 1" damping=".2"/>
      <camera name="side" pos="0 -2 0" xyaxes="1 0 0 0 0 1" mode="track"/>
      <geom name="arm" type="capsule" fromto="0 0 0 .12 0 0" size=".015"/>
      <body name="hand" pos=".12 0 0">
        <joint name="elbow" axis="0 0 1" damping=".2"/>
        <camera name="eye"/>
        <geom name="hand" type="capsule" fromto="0 0 0 .1 0 0" size=".012"/>
        <site name="tip" type="box" pos=".1 0 0" euler="0 0 30" size=".01 .02 .01" rgba="0 1 0 1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="shoulder" ctrlrange="-.1 .1"/>
    <motor joint="elbow" ctrlrange="-.1 .1"/>
  </actuator>
</mujoco>
"""


def near(before, after, action):
    return -jnp.linalg.norm(after.xpos("hand") - after.xpos("goal"))


def anywhere(key):
    goal, arm = jax.random.split(key)
    goal = jax.random.uniform(goal, (3,), minval=-0.2, maxval=0.2) * jnp.array([1, 1, 0.1])
    arm = jax.random.uniform(arm, (2,), minval=-3, maxval=3)
    return jnp.concatenate([goal, arm]), jnp.zeros(5)


def model():
    return mujoco.MjModel.from_xml_string(REACHER)


@pytest.fixture(scope="module")
def task():
    pb.register(
        "own_reacher",
        lambda: pb.mjcf_physics(REACHER, reward=near, reset=anywhere),
    )
    return "own_reacher"


@pytest.fixture(scope="module")
def made(task):
    return pb.make(task, height=24, width=24, frame_stack=1, camera="above")


def test_a_goal_for_each_episode(made):
    """Formulas see where it is, the picture shows it, and there it stays."""
    env, params = made
    goals = []
    for seed in range(2):
        state, _ = env.reset(jax.random.key(seed), params)
        physics = state.sim.physics
        goal = physics.obs[:3]
        np.testing.assert_allclose(physics.xpos[0], goal + jnp.array([0, 0, 0.05]), atol=1e-6)
        reds = np.asarray(state.frames, int) @ [1, -1, -1] > 60
        rows, columns = np.nonzero(reds)
        pixel = 0.95 * 2 * np.tan(np.pi / 8) / 24
        middle = np.array([columns.mean() - 11.5, 11.5 - rows.mean()]) * pixel
        np.testing.assert_allclose(middle, goal[:2], atol=pixel)
        for _ in range(3):
            state, timestep = env.step(state, jnp.ones(2), params)
        after = state.sim.physics
        np.testing.assert_allclose(after.obs[:3], goal, atol=1e-5)
        expected = -np.linalg.norm(after.xpos[2] - after.xpos[0])
        np.testing.assert_allclose(timestep.reward, expected, atol=1e-6)
        goals.append(np.asarray(goal))
    assert np.abs(goals[0] - goals[1]).min() > 1e-4


def test_sites_are_where_mujoco_has_them(made):
    geoms = made[0].physics.geoms
    assert [name for name in geoms.name if name.startswith("site/")] == ["site/start", "site/tip"]
    tip, site = geoms.name.index("site/tip"), model().site("tip")
    assert geoms.link[tip] == 2
    np.testing.assert_allclose(geoms.pos[tip], site.pos, atol=1e-6)
    np.testing.assert_allclose(geoms.quat[tip], site.quat, atol=1e-6)
    np.testing.assert_allclose(geoms.size[tip], site.size, atol=1e-6)
    np.testing.assert_allclose(geoms.rgb[geoms.material[tip]], [0, 1, 0])


def test_groups_hide_sites_too():
    assert [site.name for site in site_shapes(model(), (3,))] == ["site/hidden"]


def test_cameras_by_name(task, made):
    rigs = pb.named_rigs(task)
    assert sorted(rigs) == ["above", "chase", "default", "front", "side", "top"]
    np.testing.assert_allclose(rigs["above"].eye, [0, 0, 1])
    # The model's own in place of the view from the side that every task has.
    assert rigs["side"].link == 1
    np.testing.assert_allclose(rigs["side"].eye, [0, -2, 0], atol=1e-6)


def test_the_center_of_mass_is_a_link(made):
    env, params = made
    state, _ = env.reset(jax.random.key(1), params)
    data = mujoco.MjData(model())
    data.qpos[:] = state.sim.physics.obs[:5]
    mujoco.mj_forward(model(), data)
    assert env.physics.link_names == ("goal", "arm", "hand", "camera/com")
    np.testing.assert_allclose(state.sim.physics.xpos[3], data.subtree_com[0], atol=1e-6)
    np.testing.assert_allclose(state.sim.physics.xquat[3], [1, 0, 0, 0])
    chase = pb.named_rigs("own_reacher")["chase"]
    eye = chase.eye + np.asarray(state.sim.physics.xpos[3])
    np.testing.assert_allclose(eye, data.cam_xpos[model().camera("chase").id], atol=1e-5)


@pytest.mark.parametrize(
    ("camera", "reason"),
    [
        ("aim", "it turns towards body 'arm'"),
        ("eye", "it turns with body 'hand'"),
        ("flat", "it has no perspective"),
        ("shifted", "its principal point is not the middle of its image"),
    ],
)
def test_cameras_that_are_no_viewpoints(task, camera, reason):
    with pytest.raises(ValueError, match=f"'{camera}' of task .* cannot be a viewpoint: {reason},"):
        pb.make(task, camera=camera)
    with pytest.raises(ValueError, match=r"unknown camera .*'chas'.*Did you mean 'chase'"):
        pb.make(task, camera="chas")


def test_cameras_of_the_suite_that_are_no_viewpoints():
    pytest.importorskip("dm_control")
    with pytest.raises(ValueError, match=r"'lookatcart' .* it turns towards body 'cart',"):
        pb.make("dmc_cartpole_balance", camera="lookatcart")


def test_the_default_view_follows_what_is_driven(task):
    """Not the goal, though it is the first body and moves."""
    assert pb.named_rigs(task)["default"].link == 1


@pytest.mark.parametrize(
    ("change", "body"),
    [
        (("", ""), "arm"),
        (('joint="shoulder"', 'joint="goal_x"'), "goal"),
        (('<motor joint="shoulder" ctrlrange="-.1 .1"/>', ""), "arm"),
        (('<joint name="shoulder" axis="0 0 1" damping=".2"/>', ""), "hand"),
    ],
)
def test_followed_body(change, body):
    xml = REACHER.replace(*change) if change[0] else REACHER
    if "shoulder" not in xml.split("<actuator>")[0]:
        xml = xml.replace('<motor joint="shoulder" ctrlrange="-.1 .1"/>', "")
    model = mujoco.MjModel.from_xml_string(xml)
    assert model.body(followed_body(model)).name == body
    # Without actuators it is the first that moves.
    rest = mujoco.MjModel.from_xml_string(xml[: xml.index("<actuator>")] + "</mujoco>")
    assert rest.body(followed_body(rest)).name == "goal"


def test_a_camera_named_default_is():
    pb.register(
        "own_view",
        lambda: pb.mjcf_physics(REACHER.replace('"above"', '"default"'), reward=near),
    )
    np.testing.assert_allclose(pb.named_rigs("own_view")["default"].eye, [0, 0, 1])


def test_start_in_a_pose(made):
    env, params = made
    key = jax.random.key(2)
    state, timestep = env.reset(key, params)
    pose = state.sim.physics.obs[:5]
    again, first = env.from_qpos(pose, None, key, params)
    for found, expected in zip(
        jax.tree.leaves((again.frames, again.sim.physics, first)),
        jax.tree.leaves((state.frames, state.sim.physics, timestep)),
        strict=True,
    ):
        np.testing.assert_allclose(found, expected, atol=1e-6)
    moving, _ = env.from_qpos(pose.at[0].set(0.15), jnp.ones(5), key, params)
    np.testing.assert_allclose(moving.sim.physics.obs[5:], 1.0)
    assert (moving.frames != state.frames).any()
    after, _ = env.step(moving, jnp.zeros(2), params)
    assert after.sim.step_count == 1
    with pytest.raises(
        ValueError, match=r"qpos and qvel must have shapes \(5,\) and \(5,\), got \(4,\)"
    ):
        env.from_qpos(pose[:4], None, key, params)
    with pytest.raises(TypeError, match=r"key must come from jax\.random\.key"):
        env.from_qpos(pose, None, 0, params)


def test_start_in_a_pose_with_the_episodes_target():
    pytest.importorskip("dm_control")
    physics = pb.make("dmc_reacher_easy", obs_mode="state")[0].physics
    key, pose = jax.random.key(3), jnp.array([0.3, -0.4])
    start = jax.jit(lambda key: (physics.first(key)[0], physics.from_qpos(pose, key=key)))
    drawn, chosen = start(key)
    np.testing.assert_array_equal(chosen.engine.target, drawn.target)
    np.testing.assert_array_equal(chosen.engine.qpos, pose)
    np.testing.assert_array_equal(chosen.obs[:2], pose)


@pytest.mark.parametrize(
    "flag", [partial(jax.enable_x64, True), partial(jax.numpy_rank_promotion, "raise")]
)
def test_a_pose_of_a_task_of_dm_control_under_flags_of_jax(flag):
    pytest.importorskip("dm_control")
    physics = pb.make("dmc_cartpole_swingup", obs_mode="state")[0].physics
    with flag():
        # A new function, whose trace JAX does not remember from another flag.
        state = jax.eval_shape(lambda q: physics.from_qpos(q), np.zeros(2))
    assert {leaf.dtype.itemsize for leaf in jax.tree.leaves(state)} <= {1, 4}


def test_physics_without_poses():
    env = pb.PixelEnv(Ball(), obs_mode="state")
    with pytest.raises(TypeError, match=r"Ball cannot start in a chosen pose: give it"):
        env.from_qpos(jnp.zeros(1), None, jax.random.key(0), limited(6))
