"""Visible geoms and their colors, against MuJoCo's own viewer."""

import mujoco
import numpy as np
import pytest

from pixelbrax_jax.physics.mujoco.geometry import as_geoms, geom_shapes
from pixelbrax_jax.renderer import intersect, reference
from pixelbrax_jax.tasks import BRAX_TASKS
from pixelbrax_jax.types import GeomKind

LOOKS = mujoco.MjModel.from_xml_string("""
<mujoco>
  <asset>
    <material name="green" rgba="0 1 0 1"/>
    <material name="clear" rgba="0 0 1 0"/>
  </asset>
  <worldbody>
    <geom name="default" size=".1"/>
    <geom name="by material" size=".1" material="green"/>
    <geom name="own over material" size=".1" material="green" rgba="1 0 0 1"/>
    <geom name="clear material" size=".1" material="clear"/>
    <geom name="own over clear" size=".1" material="clear" rgba="1 0 0 1"/>
    <geom name="clear over material" size=".1" material="green" rgba="1 0 0 0"/>
    <geom name="clear" size=".1" rgba="1 0 0 0"/>
    <geom name="hidden group" size=".1" group="3"/>
    <geom name="glass" size=".1" rgba="1 0 0 .3"/>
    <geom name="ground" type="plane" size="1 1 .1"/>
    <geom type="box" size=".1 .2 .3"/>
    <geom type="ellipsoid" size=".1 .2 .3"/>
    <geom type="cylinder" size=".1 .2"/>
    <geom type="capsule" size=".1 .2"/>
  </worldbody>
</mujoco>
""")


def read_geoms(model, **options):
    return as_geoms(geom_shapes(model, **options))


def viewer(model):
    """{geom index: rgb} that MuJoCo's viewer would draw."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    scene = mujoco.MjvScene(model, 1000)
    option, camera = mujoco.MjvOption(), mujoco.MjvCamera()
    everything = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, data, option, None, camera, everything, scene)
    drawn = scene.geoms[: scene.ngeom]
    return {g.objid: g.rgba[:3].copy() for g in drawn if g.objtype == mujoco.mjtObj.mjOBJ_GEOM}


def assert_as_in_viewer(model, geoms):
    shown = viewer(model)
    assert len(geoms.name) == len(shown)
    for index, (original, rgb) in enumerate(sorted(shown.items())):
        assert geoms.name[index] == (model.geom(original).name or geoms.name[index])
        assert geoms.kind[index] == model.geom_type[original]
        np.testing.assert_allclose(geoms.rgb[geoms.material[index]], rgb, atol=1e-6)


def test_colors_and_visibility():
    geoms = read_geoms(LOOKS)
    assert_as_in_viewer(LOOKS, geoms)
    assert geoms.name[-4:] == ("box/10", "ellipsoid/11", "cylinder/12", "capsule/13")
    assert "hidden group" not in geoms.name
    np.testing.assert_allclose(geoms.size[geoms.name.index("capsule/13")], [0.1, 0.2, 0])
    np.testing.assert_allclose(geoms.size[geoms.name.index("default")], [0.1, 0, 0])


@pytest.mark.parametrize("task", sorted(BRAX_TASKS))
def test_colors_of_the_tasks(task, unfused_model):
    model = unfused_model(task)
    assert_as_in_viewer(model, read_geoms(model))


def test_equal_colors_share_a_material_but_a_ground_has_its_own():
    geoms = read_geoms(LOOKS)
    row = dict(zip(geoms.name, geoms.material, strict=True))
    assert row["own over material"] == row["own over clear"] == row["glass"]
    assert row["default"] == row["box/10"]
    assert row["default"] != row["ground"]
    np.testing.assert_array_equal(geoms.rgb[row["default"]], geoms.rgb[row["ground"]])
    assert len(geoms.rgb) == 4


def test_chosen_groups():
    assert read_geoms(LOOKS, geom_groups=(3,)).name == ("hidden group",)
    with pytest.raises(ValueError, match=r"no geom is visible: .* outside \(4,\)"):
        read_geoms(LOOKS, geom_groups=(4,))


def test_replaced_color():
    geoms = read_geoms(LOOKS, colors={"ground": (0.25, 0.5, 0.75), "box/10": (1, 0, 0)})
    row = dict(zip(geoms.name, geoms.material, strict=True))
    np.testing.assert_array_equal(geoms.rgb[row["ground"]], [0.25, 0.5, 0.75])
    assert row["box/10"] == row["glass"]


@pytest.mark.parametrize("color", [(0, 0, 2), (0, 0), (0, 0, float("nan")), (255, 0, 0)])
def test_bad_color(color):
    with pytest.raises(ValueError, match=r"color of geom 'ground' .* \[0, 1\], got"):
        read_geoms(LOOKS, colors={"ground": color})
    with pytest.raises(ValueError, match=r"unknown geom: 'grund'.*Did you mean 'ground'"):
        read_geoms(LOOKS, colors={"grund": (0, 0, 0)})


MESH = """
<mujoco>
  <asset><mesh name="tetra" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>
  <worldbody>
    <geom name="ball" size=".1"/>
    <body><joint/><geom name="shell" type="mesh" mesh="tetra" {more}/></body>
  </worldbody>
  <actuator/>
</mujoco>
"""


HILLS = """
<mujoco>
  <asset><hfield name="hills" nrow="3" ncol="3" size="1 1 1 1"/></asset>
  <worldbody><geom type="hfield" hfield="hills"/></worldbody>
</mujoco>
"""
SKIN = """
<mujoco>
  <deformable>
    <skin name="hide" {more} vertex="0 0 0 1 0 0 0 1 0" face="0 1 2">
      <bone body="b" bindpos="0 0 0" bindquat="1 0 0 0" vertid="0 1 2" vertweight="1 1 1"/>
    </skin>
  </deformable>
  <worldbody><body name="b"><geom name="ball" size=".1"/></body></worldbody>
</mujoco>
"""
CLOTH = """
<mujoco><worldbody>
  <flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" dim="2" mass="1"
            radius=".01"/>
</worldbody></mujoco>
"""


@pytest.mark.parametrize(
    ("xml", "message"),
    [
        (
            HILLS,
            r"cannot be rendered: hfield 'hfield/0' \(group 0\)\. Supported geoms: plane, sphere, "
            r"capsule, ellipsoid, cylinder, box, mesh\. Replace the others .* alpha 0",
        ),
        (SKIN.format(more='group="2"'), r"cannot be rendered: skin 'hide' \(group 2\)"),
        (CLOTH, "cannot be rendered: flex 'cloth'"),
        (
            SKIN.format(more="").replace("</mujoco>", "") + HILLS.replace("<mujoco>", ""),
            r"hfield 'hfield/0' \(group 0\), skin 'hide' \(group 0\)\. S",
        ),
    ],
)
def test_what_cannot_be_drawn_is_named(xml, message):
    with pytest.raises(ValueError, match=message):
        read_geoms(mujoco.MjModel.from_xml_string(xml))


@pytest.mark.parametrize("more", ['rgba="1 1 1 0"', 'group="4"'])
@pytest.mark.parametrize("xml", [MESH, SKIN], ids=["mesh", "skin"])
def test_what_is_hidden_is_no_concern(xml, more):
    assert read_geoms(mujoco.MjModel.from_xml_string(xml.format(more=more))).name == ("ball",)


def test_task_colors_name_geoms_that_exist(program):
    for task, spec in BRAX_TASKS.items():
        if not spec.colors:
            continue
        geoms = program(task).physics.geoms
        for name, color in spec.colors.items():
            row = geoms.material[geoms.name.index(name)]
            np.testing.assert_allclose(geoms.rgb[row], color, atol=1e-6)


def test_the_pushers_nameless_goal_is_the_one_recolored(program):
    physics = program("pusher").physics
    index = physics.geoms.name.index("capsule/20")
    assert physics.link_names[physics.geoms.link[index]] == "goal"
    np.testing.assert_allclose(physics.geoms.size[index], [0.08, 0.001, 0])


# Vienot, Brettel and Mollon, "Digital video colourmaps for checking the legibility of displays
# by dichromats" (1999): RGB to LMS, and what a deuteranope's missing M cone is replaced by.
_LMS = np.array(
    [[17.8824, 43.5161, 4.11935], [3.45565, 27.1554, 3.86714], [0.0299566, 0.184309, 1.46709]]
)
_DEUTERANOPE = np.array([[1, 0, 0], [0.494207, 0, 1.24827], [0, 0, 1]])
_XYZ = np.array(
    [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
)  # fmt: skip


def lab(rgb, deuteranope):
    """CIELAB of a color, as full or as deuteranopic vision sees it."""
    linear = np.asarray(rgb, float) ** 2.2
    if deuteranope:
        linear = np.clip(np.linalg.solve(_LMS, _DEUTERANOPE @ _LMS @ linear), 0, 1)
    x, y, z = np.cbrt(_XYZ @ linear / _XYZ.sum(axis=1))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("deuteranope", [False, True])
@pytest.mark.parametrize(
    ("task", "names"),
    [
        ("reacher", ("target", "fingertip", "link1")),
        ("pusher", ("object_geom", "capsule/20", "fa")),
    ],
)
def test_targets_stand_out(task, names, deuteranope, program):
    """Differences of 10 are seen at a glance; we ask for 20 between any two."""
    geoms = program(task).physics.geoms
    seen = [lab(geoms.rgb[geoms.material[geoms.name.index(n)]], deuteranope) for n in names]
    for i in range(3):
        for j in range(i):
            difference = np.linalg.norm(seen[i] - seen[j])
            assert difference > 20, (names[i], names[j], difference)


def test_kinds_are_mujocos_numbers():
    for kind in GeomKind:
        assert int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind.name}")) == kind


def test_every_kind_has_its_formulas():
    for table in (intersect._BY_KIND, reference._LOCAL):
        assert set(table) == set(GeomKind)
    assert set(intersect._FAR_FORMS) == {kind for kind in GeomKind if kind.has_far_form}
    for kind in GeomKind:
        assert 1 <= kind.num_sizes <= 3
        assert kind.reach in ("first", "largest", "diagonal", "all")
