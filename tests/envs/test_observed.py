"""Depth, segmentation and several cameras as observations."""

from __future__ import annotations

import importlib.util

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import pixelbrax_jax as pb
from pixelbrax_jax import PixelEnv, VectorPixelEnv, check_env, make_rig
from pixelbrax_jax.distractors import Color, Distractor, MovingCamera, Video
from pixelbrax_jax.observations import MAX_DEPTH
from pixelbrax_jax.scene.cameras import aim
from tests.envs.toy import PARAMS, Ball
from tests.renderer.mujoco_rays import cast_rays

SIZE = {"height": 16, "width": 16, "frame_stack": 2}
ALL = "pixels+depth+segmentation+state"
RIGHT = jnp.ones(1)
ABOVE = make_rig((0.2, -0.5, 5.0), (0.0, 0.0, 0.0), 40.0)
TWO = PARAMS.replace(rig=(PARAMS.rig, ABOVE))


def test_every_part_is_that_of_the_rendered_frame():
    env = PixelEnv(Ball(), obs_mode=ALL, **SIZE)
    state, first = env.reset(jax.random.key(0), PARAMS)
    before = env.render(state, PARAMS)
    state, timestep = env.step(state, RIGHT, PARAMS)
    frame = env.render(state, PARAMS)
    assert list(timestep.obs) == ["depth", "pixels", "segmentation", "state"]
    for obs, (old, new) in ((first.obs, (before, before)), (timestep.obs, (before, frame))):
        for k, shown in enumerate((old, new)):
            np.testing.assert_array_equal(obs["segmentation"][..., k], shown.seg)
            np.testing.assert_allclose(
                obs["depth"][..., k], np.minimum(shown.depth, MAX_DEPTH), rtol=1e-4
            )
    depth, seg = (timestep.obs[name][..., -1] for name in ("depth", "segmentation"))
    # Sky, ground and ball.
    assert set(np.unique(seg)) == {-1, 0, 1}
    assert (depth[seg < 0] == MAX_DEPTH).all()
    # From the camera's height of 1 m, 4 m away, to the nearest point of a ball of 0.3 m.
    assert float(depth[seg == 1].min()) == pytest.approx(np.sqrt(17) - 0.3, abs=0.05)
    assert (before.depth != frame.depth).any()
    plain = PixelEnv(Ball(), **SIZE)
    state, _ = plain.reset(jax.random.key(0), PARAMS)
    np.testing.assert_array_equal(timestep.obs["pixels"], plain.step(state, RIGHT, PARAMS)[1].obs)


@pytest.mark.parametrize(
    ("obs_mode", "params"),
    [
        pytest.param("depth", PARAMS, marks=pytest.mark.slow),
        (ALL, TWO),
        pytest.param("segmentation", TWO, marks=pytest.mark.slow),
    ],
)
def test_the_rules_of_environments_hold(obs_mode, params):
    num_cameras = 2 if params is TWO else 1
    env = PixelEnv(Ball(), obs_mode=obs_mode, num_cameras=num_cameras, **SIZE)
    check_env(env, params)
    spec = env.obs_spec if obs_mode == ALL else {obs_mode: env.obs_spec}
    found = {name: (part.shape, part.dtype.name) for name, part in spec.items()}
    every = {
        "pixels": ((16, 16, 6 * num_cameras), "uint8"),
        "depth": ((16, 16, 2 * num_cameras), "float32"),
        "segmentation": ((16, 16, 2 * num_cameras), "int32"),
        "state": ((2,), "float32"),
    }
    assert found == {name: every[name] for name in found}


@pytest.mark.parametrize("mode", ["next_step", pytest.param("same_step", marks=pytest.mark.slow)])
def test_two_cameras_see_what_two_environments_see(mode):
    def episodes(num_cameras, params):
        env = PixelEnv(Ball(), obs_mode=ALL, num_cameras=num_cameras, **SIZE)
        venv = VectorPixelEnv(env, 3, mode)
        state, timestep = venv.reset(jax.random.key(1), params)
        steps = [timestep.obs]
        for _ in range(12):
            action = jnp.array([[1.0], [0.5], [-1.0]])
            state, timestep = venv.step(state, action, params)
            steps.append(timestep.obs)
        return jax.device_get(steps)

    both = episodes(2, TWO)
    for c, rig in enumerate(TWO.rig):
        for ours, theirs in zip(both, episodes(1, PARAMS.replace(rig=rig)), strict=True):
            for name, channels in (("pixels", 3), ("depth", 1), ("segmentation", 1)):
                frames = ours[name].reshape(3, 16, 16, 2, 2, channels)[:, :, :, :, c]
                frames = frames.reshape(theirs[name].shape)
                # The compiler may round a depth differently in another program.
                most = 1e-6 if name == "depth" else 0.0
                np.testing.assert_allclose(frames, theirs[name], rtol=most)
    # The first ball passes the end of the line on its way.
    assert (both[-1]["segmentation"][0] != both[0]["segmentation"][0]).any()


def test_sizes_have_the_order_of_the_cameras():
    both = {"top": (24, 48), "front": (36, 32)}
    config = pb.EnvConfig(camera=("front", "top"), camera_sizes=both)
    assert config.camera_sizes == (("front", 36, 32), ("top", 24, 48))
    assert (config.height, config.width) == (36, 32)
    rig = make_rig((0.2, -0.5, 5.0), (0.0, 0.0, 0.0), 40.0)
    config = pb.EnvConfig(camera=(rig, "top"), camera_sizes={"top": (24, 48), "mine": (9, 9)})
    assert config.camera_sizes == (("mine", 9, 9), ("top", 24, 48))


def test_each_camera_has_its_own_sky():
    texture = np.random.default_rng(0).uniform(0, 0.5, (6, 4, 4, 3)).astype(np.float32)
    rigs = (make_rig((0, -3, 1), (0, 0, 2), 60.0), make_rig((-3, 0, 1), (0, 0, 2), 60.0))
    look = PARAMS.look.replace(sky_texture=texture)
    both = PixelEnv(Ball(), num_cameras=2, height=16, width=16, frame_stack=1)
    obs = both.reset(jax.random.key(0), PARAMS.replace(rig=rigs, look=look))[1].obs
    one = PixelEnv(Ball(), height=16, width=16, frame_stack=1)
    for c, rig in enumerate(rigs):
        alone = one.reset(jax.random.key(0), PARAMS.replace(rig=rig, look=look))[1].obs
        np.testing.assert_array_equal(obs[..., 3 * c : 3 * c + 3], alone)
    assert (obs[..., :3] != obs[..., 3:]).any()


def test_cameras_of_their_own_sizes_see_what_environments_of_these_sizes_see():
    parts, sizes = "pixels+depth+state", {"own": (16, 16), "above": (10, 24)}
    env = PixelEnv(Ball(), obs_mode=parts, num_cameras=2, camera_sizes=sizes, frame_stack=2)
    check_env(env, TWO)
    assert {name: part.shape for name, part in env.obs_spec.items()} == {
        "pixels/own": (16, 16, 6),
        "pixels/above": (10, 24, 6),
        "depth/own": (16, 16, 2),
        "depth/above": (10, 24, 2),
        "state": (2,),
    }

    def episodes(env, params):
        venv = VectorPixelEnv(env, 3)
        state, timestep = venv.reset(jax.random.key(1), params)
        steps = [timestep.obs]
        for _ in range(6):
            state, timestep = venv.step(state, jnp.array([[1.0], [0.5], [-1.0]]), params)
            steps.append(timestep.obs)
        return jax.device_get(steps)

    together = episodes(env, TWO)
    for (name, (height, width)), rig in zip(sizes.items(), TWO.rig, strict=True):
        alone = PixelEnv(Ball(), obs_mode=parts, height=height, width=width, frame_stack=2)
        for ours, theirs in zip(together, episodes(alone, PARAMS.replace(rig=rig)), strict=True):
            np.testing.assert_array_equal(ours[f"pixels/{name}"], theirs["pixels"])
            np.testing.assert_allclose(ours[f"depth/{name}"], theirs["depth"], rtol=1e-6)
    assert (together[-1]["pixels/above"] != together[0]["pixels/above"]).any()


@pytest.mark.skipif(importlib.util.find_spec("dm_control") is None, reason="needs dm_control")
def test_depth_and_segmentation_are_those_of_mujocos_rays():
    """On a DM Control task, with MuJoCo's own model, kinematics and camera."""
    from pixelbrax_jax.physics.dmc.models import load_spec

    size = 24
    env, params = pb.make(
        "dmc_cartpole_swingup", height=size, width=size, frame_stack=1,
        obs_mode="depth+segmentation", camera=("fixed", "side"), engine="mujoco",
    )  # fmt: skip
    qpos = np.array([0.4, 2.5])
    state, timestep = env.from_qpos(qpos, None, jax.random.key(0), params)
    model = load_spec("cartpole").compile()
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    names = np.array([*params.geoms.name, "sky"])
    for c, rig in enumerate(params.rig):
        camera = aim(rig, state.sim.physics.xpos)
        if c == 0:
            np.testing.assert_allclose(camera.pos, data.cam_xpos[0], atol=1e-5)
        seg, depth = cast_rays(model, data, camera.pos, camera.xmat, camera.fovy, size, size)
        of_mujoco = np.array(
            [model.geom(g).name or f"unnamed {g}" for g in range(model.ngeom)] + ["sky"]
        )[seg]
        ours = names[timestep.obs["segmentation"][..., c]]
        named = np.char.find(of_mujoco, "unnamed") < 0
        agree = (of_mujoco == ours) | ~named
        assert agree.mean() >= 0.99
        assert len(set(ours[named].ravel())) >= 3
        both = agree & (seg >= 0) & (depth < MAX_DEPTH)
        np.testing.assert_allclose(timestep.obs["depth"][..., c][both], depth[both], rtol=1e-3)
        assert (timestep.obs["depth"][..., c][(seg < 0) & agree] == MAX_DEPTH).all()


def test_the_order_of_parts_does_not_matter():
    assert pb.EnvConfig(obs_mode="state+pixels") == pb.EnvConfig(obs_mode="both")
    assert pb.EnvConfig(obs_mode="state+depth").obs_mode == "depth+state"
    assert pb.EnvConfig(camera=["front"]) == pb.EnvConfig(camera="front")


class Dimmer(Distractor):
    """A user's."""

    kind, stream = "dimmer", 99
    only_colors = one_camera = True


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"obs_mode": "rgbd"}, "unknown obs_mode: 'rgbd'; allowed: both, depth, pixels, segm"),
        ({"obs_mode": "pixels+rgb"}, r"obs_mode='pixels\+rgb' must join different ones of pixels"),
        ({"obs_mode": "pixels,depth"}, r"obs_mode='pixels,depth' must join .* by '\+'"),
        ({"obs_mode": "depth+depth"}, r"obs_mode='depth\+depth' must join different ones"),
        ({"obs_mode": 3}, "unknown obs_mode: 3"),
        ({"camera": ("front", "side", "front")}, "has 'front' twice; give each viewpoint once"),
        ({"camera": ()}, "at least one viewpoint"),
        ({"camera": ("front", "sid")}, "unknown camera of task 'inverted_pendulum': 'sid'"),
        ({"obs_mode": "depth", "distractors": Color()}, "'color' changes only colors, which"),
        ({"obs_mode": "depth+state", "distractors": Video()}, "'video' changes only colors"),
        ({"obs_mode": "depth", "distractors": Dimmer()}, "'dimmer' changes only colors"),
        (
            {"camera": ("front", "top"), "distractors": Dimmer()},
            "'dimmer' moves one camera, but there are 2",
        ),
        ({"camera_sizes": {"top": (36, 36)}}, "several cameras, got only 'top': use height and"),
        ({"camera_sizes": {"front": 36, "top": 36}}, "a height and a width by the name of each"),
        ({"camera_sizes": (("a", 36, 36), ("a", 24, 24))}, "different names, got a, a"),
        ({"camera_sizes": {"a": (36, 36), "top": (0, 9)}}, r"camera_sizes\['top'\] must be a pos"),
        ({"camera_sizes": {"a": (36, 36), "top": (9, 9)}}, "of the cameras, default; got a, top"),
        (
            {"camera": ("front", "top"), "camera_sizes": {"front": (9, 9), "side": (9, 9)}},
            "of the cameras, front, top; got front, side",
        ),
        (
            {"camera_sizes": {"a": (9, 9), "b": (9, 9)}, "obs_mode": "state"},
            "need images, but obs_mode='state' has none: leave them out",
        ),
        (
            {"camera": ("front", "top"), "distractors": "camera"},
            "moves one camera, but there are 2",
        ),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        pb.make("inverted_pendulum", **options)


def test_each_environment_may_have_its_own_cameras():
    env = PixelEnv(Ball(), obs_mode="segmentation", num_cameras=2, **SIZE)
    eyes = np.stack([ABOVE.eye, ABOVE.eye + np.float32([0.5, 0, 0])])
    params = TWO.replace(rig=(PARAMS.rig, ABOVE.replace(eye=eyes)))
    _, timestep = VectorPixelEnv(env, 2).reset(jax.random.key(0), params)
    keys = VectorPixelEnv.env_keys(jax.random.key(0), 2)
    for i, eye in enumerate(eyes):
        own = TWO.replace(rig=(PARAMS.rig, ABOVE.replace(eye=eye)))
        np.testing.assert_array_equal(timestep.obs[i], env.reset(keys[i], own)[1].obs)


def test_params_have_as_many_rigs_as_cameras():
    env = PixelEnv(Ball(), **SIZE)
    with pytest.raises(ValueError, match="camera_sizes has 2 cameras, num_cameras=3"):
        PixelEnv(Ball(), num_cameras=3, camera_sizes={"a": (9, 9), "b": (9, 9)})
    with pytest.raises(ValueError, match="num_cameras=1 rigs, got 2"):
        env.reset(jax.random.key(0), TWO)


def test_a_moving_camera_moves_depth():
    env = PixelEnv(Ball(), obs_mode="depth", distractors=(MovingCamera(scale=0.5),), **SIZE)
    plain = PixelEnv(Ball(), obs_mode="depth", **SIZE)
    moved, still = (e.reset(jax.random.key(0), PARAMS)[1].obs for e in (env, plain))
    assert (moved != still).any()
    assert np.isfinite(moved).all()
