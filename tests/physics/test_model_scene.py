"""What a MuJoCo model says about its picture: planes, sites, tendons, cameras, lights."""

from __future__ import annotations

import re

import mujoco
import numpy as np
import pytest

from pixelbrax_jax import make_look, make_rig
from pixelbrax_jax.physics.mujoco.lighting import detailed
from pixelbrax_jax.physics.mujoco.scene import read_scene, tracked_body
from pixelbrax_jax.scene.place import place
from pixelbrax_jax.types import GeomKind

MODEL = """
<mujoco>
  <visual><headlight ambient=".3 .3 .3" diffuse=".6 .6 .6"/></visual>
  <asset>
    <texture name="checker" type="2d" builtin="checker" rgb1=".2 .4 .6" rgb2=".8 .6 .4"
             width="40" height="40" mark="edge" markrgb="1 0 0"/>
    <texture name="flat" type="2d" builtin="flat" rgb1=".2 .4 .6" width="8" height="8"/>
    <texture name="sky" type="skybox" builtin="gradient" rgb1=".4 .6 .8" rgb2="0 0 0"
             width="100" height="100"/>
    <material name="floor" texture="checker" texrepeat="2 2" texuniform="true"/>
    <material name="plain" texture="flat"/>
    <material name="skin" rgba=".7 .5 .3 1"/>
  </asset>
  <worldbody>
    <light name="sun" directional="true" dir="1 0 -1" diffuse=".5 .5 .5" specular=".2 .2 .2"/>
    <light name="spot" pos="1 1 3" cutoff="30" exponent="4" diffuse=".7 .7 .7"/>
    <light name="off" pos="0 0 9" active="false"/>
    <camera name="fixed" pos="0 -4 1" xyaxes="1 0 0 0 0 1" fovy="30"/>
    <camera name="down" pos="0 0 3" xyaxes="1 0 0 0 1 0"/>
    <camera name="aimed" pos="0 -2 2" mode="targetbody" target="arm"/>
    <geom name="ground" type="plane" size="2 0 .1" material="floor"/>
    <geom name="wall" type="plane" size=".5 .1 .1" pos="2 0 .1" zaxis="-1 0 0" material="plain"/>
    <geom name="goal" size=".05" pos=".5 .6 .7" material="skin"/>
    <site name="mark" size=".02" pos=".5 .6 .9" rgba="1 0 0 1"/>
    <site name="hidden" size=".02" group="4"/>
    <site name="clear" size=".02" rgba="1 0 0 0"/>
    <site name="hook" size=".01" pos="0 0 2"/>
    <body name="arm" pos="0 0 1">
      <joint name="arm" type="ball"/>
      <light name="lamp" pos="0 0 2" mode="trackcom"/>
      <camera name="follow" pos="0 -3 0" xyaxes="1 0 0 0 0 1" mode="trackcom"/>
      <camera name="track" pos="0 -3 0" xyaxes="1 0 0 0 0 1" mode="track"/>
      <camera name="eye" pos="0 0 .1"/>
      <geom name="arm" type="capsule" fromto="0 0 0 0 0 -.5" size=".05" material="skin"/>
      <site name="hand" type="box" size=".01 .02 .03" pos="0 0 -.5" material="skin"/>
    </body>
  </worldbody>
  <tendon>
    <spatial name="string" limited="true" range="0 .6" width=".004" rgba="0 1 0 1">
      <site site="hook"/><site site="hand"/>
    </spatial>
    <spatial name="spring" stiffness="3" width=".002">
      <site site="hook"/><site site="hand"/>
    </spatial>
    <spatial name="unseen" group="5"><site site="hook"/><site site="hand"/></spatial>
  </tendon>
</mujoco>
"""


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(MODEL)


@pytest.fixture(scope="module")
def scene(model):
    return read_scene(model, model.camera("follow").id, movable=("goal", "mark", "spot"))


def row(geoms, name):
    return geoms.name.index(name)


def test_planes(scene):
    geoms = scene.geoms
    ground, wall, arm = (row(geoms, name) for name in ("ground", "wall", "arm"))
    assert [geoms.is_bounded(g) for g in (ground, wall, arm)] == [True, True, False]
    assert [geoms.is_ground(g) for g in (ground, wall, arm)] == [True, False, False]
    assert geoms.material_name[geoms.material[ground]] == "floor"
    np.testing.assert_allclose(geoms.size[ground, :2], [2.0, 0.0])


def test_sites_are_geoms_in_the_colors_of_materials(scene):
    geoms = scene.geoms
    assert {name for name in geoms.name if name.startswith("site/")} == {
        "site/mark",
        "site/hook",
        "site/hand",
    }
    hand = row(geoms, "site/hand")
    assert geoms.kind[hand] == GeomKind.BOX
    assert geoms.link[hand] == 0
    assert geoms.material[hand] == geoms.material[row(geoms, "arm")]
    np.testing.assert_allclose(geoms.pos[hand], [0, 0, -0.5])
    np.testing.assert_allclose(geoms.rgb[geoms.material[row(geoms, "site/mark")]], [1, 0, 0])


def test_tendons_are_strings(scene, model):
    string, spring = scene.geoms.strings
    assert string.length == pytest.approx(0.6)
    assert spring.length == 0.0, "a spring is straight"
    assert len(spring.geoms) == 1 < len(string.geoms)
    assert string.link == (-1, 0)
    np.testing.assert_allclose(string.ends, [[0, 0, 2], [0, 0, -0.5]])
    assert {scene.geoms.kind[g] for g in string.geoms} == {GeomKind.CAPSULE}
    assert not any("unseen" in name for name in scene.geoms.name)
    np.testing.assert_allclose(scene.geoms.size[list(string.geoms), 0], 0.004)


def test_what_moves_is_on_a_link_of_its_own(scene, model):
    assert scene.links == ("camera/com", "target")
    assert tracked_body(model) == model.body("arm").id
    target = model.nbody - 1 + scene.links.index("target")
    geoms = scene.geoms
    goal, mark = row(geoms, "goal"), row(geoms, "site/mark")
    assert geoms.link[goal] == geoms.link[mark] == target
    np.testing.assert_allclose(geoms.pos[goal], 0.0, atol=1e-7)
    np.testing.assert_allclose(geoms.pos[mark], [0, 0, 0.2], atol=1e-6)
    spot, lamp = scene.look.lamps
    assert spot.link == target
    np.testing.assert_allclose(spot.pos, [0.5, 0.4, 2.3], atol=1e-6)
    assert lamp.link == scene.rig.link == model.nbody - 1
    # The middle of the arm is 0.25 below its body, 2 below the lamp.
    np.testing.assert_allclose(lamp.pos, [0, 0, 2.25], atol=1e-5)


def test_nothing_movable_is_no_link(model):
    assert read_scene(model).links == ("camera/com",)


def test_cameras(scene, model):
    assert set(scene.rigs) == {"fixed", "down", "follow", "track"}
    fixed, down, track = (scene.rigs[name] for name in ("fixed", "down", "track"))
    assert (fixed.link, track.link) == (-1, 0)
    assert fixed.fovy == 30
    np.testing.assert_allclose(fixed.eye, [0, -4, 1])
    # As deep as the center of mass, which is straight ahead; and straight below.
    np.testing.assert_allclose(fixed.target, [0, 0, 1], atol=1e-5)
    np.testing.assert_allclose(down.target, [0, 0, 0.75], atol=1e-2)
    np.testing.assert_allclose(scene.rig.eye, [0, -3, 0.25], atol=1e-5)
    np.testing.assert_allclose(track.eye, [0, -3, 0], atol=1e-5)


def test_lights(scene):
    look = scene.look
    np.testing.assert_allclose(look.light, [-(0.5**0.5), 0, 0.5**0.5], atol=1e-6)
    assert (look.ambient, look.headlight) == (pytest.approx(0.3), pytest.approx(0.6))
    assert (look.diffuse, look.highlight) == (pytest.approx(0.5), pytest.approx(0.5 * 0.2))
    spot = look.lamps[0]
    assert (spot.exponent, float(spot.diffuse)) == (4, pytest.approx(0.7))
    assert spot.cos_cutoff == pytest.approx(np.cos(np.deg2rad(30)))
    assert len(look.lamps) == 2, "one is off"


def test_ground_and_sky_come_from_the_textures(scene):
    look = scene.look
    np.testing.assert_allclose(look.ground_rgb, [[0.2, 0.4, 0.6], [0.8, 0.6, 0.4]], atol=2e-3)
    # Two repeats a metre of MuJoCo's uniform texture, which is 2 m and has two tiles.
    assert look.ground_pitch == pytest.approx(0.5)
    assert look.ground_mark is None
    horizon, above, below = look.sky
    np.testing.assert_allclose(horizon, [0.2, 0.3, 0.4], atol=0.03)
    assert (above > horizon + 0.1).all()
    assert (above <= [0.4, 0.6, 0.8]).all()
    assert (below < 0.1).all()


@pytest.mark.parametrize(
    ("size", "repeat", "uniform", "pitch"),
    [
        ("0 0 1", "2 2", "true", 0.5),
        ("0 0 1", "2 2", "false", 0.5),
        ("10 10 1", "2 2", "true", 0.5),
        ("10 10 1", "2 2", "false", 5.0),
        ("10 5 1", "4 2", "false", 2.5),
        ("10 0 1", "4 .4", "false", 2.5),
    ],
)
def test_tiles_of_planes_that_end_or_do_not(size, repeat, uniform, pitch):
    xml = MODEL.replace('size="2 0 .1"', f'size="{size}"').replace(
        'texrepeat="2 2" texuniform="true"', f'texrepeat="{repeat}" texuniform="{uniform}"'
    )
    assert read_scene(mujoco.MjModel.from_xml_string(xml)).look.ground_pitch == pytest.approx(pitch)


def test_tiles_have_a_size():
    model = mujoco.MjModel.from_xml_string(MODEL.replace('texrepeat="2 2"', 'texrepeat="0 2"'))
    with pytest.raises(ValueError, match="material 'floor' of a plane has texrepeat 0"):
        read_scene(model)


def test_tiles_that_are_no_squares_are_told():
    xml = MODEL.replace('texrepeat="2 2"', 'texrepeat="2 4"')
    with pytest.warns(UserWarning, match=r"tiles of plane 'ground' are 0\.5 by 0\.25 m"):
        read_scene(mujoco.MjModel.from_xml_string(xml))


@pytest.mark.parametrize(
    ("changes", "shows"),
    [
        ({}, True),
        ({"rgb1": "1 0 0"}, False),
        ({"texrepeat": "7 7"}, False),
    ],
)
def test_other_checkered_planes(changes, shows):
    """Those of other colors or sizes show their mean color."""
    values = {"rgb1": ".2 .4 .6", "texrepeat": "2 2"} | changes
    xml = MODEL.replace(
        "</asset>",
        f'''<texture name="other" type="2d" builtin="checker" rgb1="{values["rgb1"]}"
            rgb2=".8 .6 .4" width="40" height="40"/>
        <material name="other" texture="other" texrepeat="{values["texrepeat"]}"
            texuniform="true"/></asset>''',
    ).replace('material="plain"', 'material="other"')
    geoms = read_scene(mujoco.MjModel.from_xml_string(xml)).geoms
    wall = row(geoms, "wall")
    assert geoms.patterned[row(geoms, "ground")]
    assert geoms.patterned[wall] == shows
    if changes == {"rgb1": "1 0 0"}:
        color = geoms.rgb[geoms.material[wall]]
        np.testing.assert_allclose(color, [0.9, 0.3, 0.2], atol=0.01)


def test_what_lights_have_that_is_not_rendered():
    lights = """
      <light name="aimed" pos="2 0 3" mode="targetbody" target="arm" cutoff="20"/>
      <light name="below" directional="true" mode="targetbodycom" target="arm" pos="0 0 -1"/>
      <light name="far" pos="0 0 3" attenuation="1 0 1"/>
      <light name="flat" castshadow="false"/>
      <light name="image" type="image" texture="sky"/>
    """
    xml = re.sub(r"<light name=.sun.*", lights, MODEL)
    xml = xml.replace('<light name="lamp"', '<light name="held"/><light name="lamp"')
    other = '<body pos="3 0 1"><geom size=".1"/><light name="com" mode="trackcom"/></body>'
    xml = xml.replace("</worldbody>", f"{other}</worldbody>")
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with pytest.warns(UserWarning, match="light") as told:
        look = read_scene(model).look
    assert [str(one.message) for one in told] == [
        "light 'aimed', 'below': lights do not turn to bodies.",
        "light 'far': attenuation is left out.",
        "light 'flat': casts shadows, because other lights do.",
        "light 'image': lights of images are left out.",
        "light 'com': left out, because it follows another center of mass than the camera.",
    ]
    names = [model.light(i).name for i in range(model.nlight) if model.light_type[i] == 0]
    names.remove("off")
    names.remove("com")
    assert len(look.lamps) == len(names)
    aimed = look.lamps[names.index("aimed")]
    np.testing.assert_allclose(aimed.axis, data.light("aimed").xdir, atol=1e-6)
    np.testing.assert_allclose(look.light, -data.light("below").xdir, atol=1e-6)
    assert look.shadows
    model.light_castshadow[:] = 0
    with pytest.warns(UserWarning, match="light"):
        assert not read_scene(model).look.shadows
    # Nor does a light that is not rendered.
    for name in ("image", "com"):
        model.light_castshadow[model.light(name).id] = 1
        with pytest.warns(UserWarning, match="light"):
            assert not read_scene(model).look.shadows


def test_what_cannot_be_drawn_is_named():
    over_a_geom = """
    <mujoco><worldbody>
      <geom name="reel" type="cylinder" size=".1 .1"/><site name="a" pos="1 0 0"/>
      <site name="b" pos="-1 0 .1"/>
      <camera/>
    </worldbody>
    <tendon>
      <spatial name="rope"><site site="a"/><geom geom="reel"/><site site="b"/></spatial>
    </tendon></mujoco>"""
    with pytest.raises(ValueError, match=r"tendon 'rope' runs over geoms .* alpha 0 or group 3"):
        read_scene(mujoco.MjModel.from_xml_string(over_a_geom))


def test_what_only_the_detailed_look_shows():
    model = mujoco.MjModel.from_xml_string(MODEL)
    plain = read_scene(model)
    assert plain.geoms.mirror == -1
    geoms = plain.geoms
    assert [geoms.name[g] for g in np.flatnonzero(geoms.textured)] == ["ground", "wall"]
    model.mat_reflectance[model.material("floor").id] = 0.3
    model.mat_reflectance[model.material("skin").id] = 0.4  # no plane
    model.vis.headlight.specular[:] = 0.2
    scene = read_scene(model)
    assert scene.geoms.mirror == row(scene.geoms, "ground")
    assert scene.look.reflectance is None
    assert scene.look.sky_texture is None
    look = detailed(model, scene.look, 0.04)
    assert look.reflectance == np.float32(0.3)
    # Half of it, as the default material's specular is 0.5.
    assert look.headlight_highlight == np.float32(0.1)
    assert look.sky_texture.shape == (6, 50, 50, 3)
    assert (look.opengl, look.shininess) == (True, 64)
    assert look.lamps == scene.look.lamps
    assert look.ground_mark is None, "red is not the second color"
    marked = mujoco.MjModel.from_xml_string(MODEL.replace('markrgb="1 0 0"', 'markrgb=".8 .6 .4"'))
    assert detailed(marked, None, 0.04).ground_mark == np.float32(2 / 40)


ROPE = """<mujoco>
  <worldbody>
    <site name="hook" pos="0 0 1"/>
    <body name="ball">
      <joint type="slide" axis="1 0 0"/><geom name="ball" size=".01" rgba=".5 .5 .5 1"/>
      <site name="ring" pos="0 0 1"/>
    </body>
  </worldbody>
  <tendon>
    <spatial name="rope" {more}><site site="hook"/><site site="ring"/></spatial>
  </tendon>
</mujoco>"""


@pytest.mark.parametrize(
    "more",
    [
        'limited="true" range="0 .3"',
        'limited="true" range=".1 .3" margin=".02"',
        'limited="true" range="0 .3" margin=".02" solimplimit=".2 .8 .1 .3 3"',
        'limited="true" range="0 .3" solimplimit="0 1 .1 1 1"',
        'limited="true" range="0 .3" rgba=".5 .5 .4 1"',
        'range="0 .3" limited="false"',
    ],
)
def test_a_tendon_beyond_its_limit_has_mujocos_color(more):
    model = mujoco.MjModel.from_xml_string(ROPE.format(more=more))
    data, geoms = mujoco.MjData(model), read_scene(model).geoms
    rig, look = make_rig((0, -1, 0), (0, 0, 0), 45.0), make_look("default")
    drawn, shown = mujoco.MjvScene(model, 100), []
    for distance in (0.05, 0.0999, 0.11, 0.2, 0.285, 0.2999, 0.3001, 0.3005, 0.31, 0.35, 0.5):
        data.qpos[0] = distance
        mujoco.mj_forward(model, data)
        views = mujoco.MjvOption(), mujoco.MjvPerturb(), mujoco.MjvCamera()
        mujoco.mjv_updateScene(model, data, *views, int(mujoco.mjtCatBit.mjCAT_ALL), drawn)
        kinds = [geom.objtype for geom in drawn.geoms[: drawn.ngeom]]
        theirs = drawn.geoms[kinds.index(int(mujoco.mjtObj.mjOBJ_TENDON))].rgba[:3]
        poses = np.float32(data.xpos[1:]), np.float32(data.xquat[1:])
        assert place(geoms, rig, look, *poses).geoms.rgb is geoms.rgb, "a detail of look='dmc'"
        placed = place(geoms, rig, look.replace(opengl=True), *poses).geoms
        (string,) = geoms.strings
        colors = np.asarray(placed.rgb)[np.array(geoms.material)]
        np.testing.assert_allclose(
            colors[list(string.geoms)], np.tile(theirs, (len(string.geoms), 1)), atol=2e-3
        )
        ball = geoms.name.index("ball")
        np.testing.assert_allclose(colors[ball], 0.5, err_msg="it shares the string's color")
        shown.append(tuple(np.round(theirs, 6)))
    turns = 'rgba="' not in more and 'limited="true"' in more
    assert (len(set(shown)) > 1) == turns
