"""Meshes as convex polytopes: analytic geometry, MuJoCo's OpenGL and its ray caster."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pixelbrax_jax import GeomKind, make_look
from pixelbrax_jax.physics.mujoco.geometry import as_geoms, geom_shapes, hull_errors
from pixelbrax_jax.physics.mujoco.scene import read_scene
from pixelbrax_jax.renderer.base import render
from pixelbrax_jax.scene.place import place
from pixelbrax_jax.spatial import look_at, make_rig
from pixelbrax_jax.types import FAR
from tests.opengl import need_opengl
from tests.renderer import scenes
from tests.renderer.mujoco_rays import cast_rays
from tests.renderer.test_lamps import LAMP

RENDERERS = ("reference", "fused", "pallas")
SIZE = 32
HALF = (0.5, 0.2, 0.3)

pytestmark = pytest.mark.usefixtures("interpreted")


def box_scene(kind):
    """A slanted box or the same mesh beside a ball on the ground, with shadows and a lamp."""
    look = make_look("default", shadows=True).replace(lamps=(LAMP,))
    size = HALF if kind == GeomKind.BOX else (float(np.linalg.norm(HALF)), 0, 0)
    mesh = {"planes": scenes.box_planes(HALF), "num_planes": (0, 6, 0)}
    scene = scenes.scene_of(
        (GeomKind.PLANE, (0, 0, 1), (0, 0, 0)),
        (kind, size, (0, 0, 0.8)),
        (GeomKind.SPHERE, (0.2, 0, 0), (0.2, -0.6, 0.6)),
        look=look,
        camera=scenes.camera((2.0, -2.5, 1.5)),
        **(mesh if kind == GeomKind.MESH else {}),
    )
    turned, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    turned *= np.linalg.det(turned)
    return scene.replace(xmat=scene.xmat.at[1].set(jnp.asarray(turned, jnp.float32)))


@pytest.mark.parametrize("renderer", RENDERERS)
def test_six_half_spaces_are_a_box(renderer):
    box, mesh = (
        render(box_scene(kind), SIZE, SIZE, renderer) for kind in (GeomKind.BOX, GeomKind.MESH)
    )
    assert set(np.unique(box.seg)) == {-1, 0, 1, 2}
    np.testing.assert_array_equal(mesh.seg, box.seg)
    np.testing.assert_allclose(mesh.depth, box.depth, rtol=1e-5)
    # Colors depend on normals, and on shadows of and on the box.
    for name in "rgb":
        np.testing.assert_allclose(getattr(mesh, name), getattr(box, name), atol=1e-4)


def polytope(normals, offsets, **options):
    normals = np.asarray(normals, float)
    planes = np.column_stack([normals, offsets]) / np.linalg.norm(normals, axis=1)[:, None]
    return scenes.scene_of(
        (GeomKind.MESH, (2.0, 0, 0), (0, 0, 0)),
        num_planes=(len(planes),),
        planes=jnp.asarray(planes, jnp.float32),
        **options,
    )


@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_tetrahedron_from_above(renderer):
    """x, y, z >= 0 and x + y + z <= 1: the pixel over (x, y) sees z = 1 - x - y."""
    scene = polytope([[-1, 0, 0], [0, -1, 0], [0, 0, -1], [1, 1, 1]], [0, 0, 0, 1])
    scene = scene.replace(camera=scenes.from_above(500.0, 0.2))
    frame = render(scene, SIZE, SIZE, renderer)
    edge = 500.0 * np.tan(np.deg2rad(0.1))
    y, x = np.meshgrid(*[(np.arange(SIZE) + 0.5 - SIZE / 2) * 2 * edge / SIZE] * 2, indexing="ij")
    z = 1 - x + y
    inside = np.minimum(np.minimum(x, -y), z)
    clear = np.abs(inside) > 0.01
    np.testing.assert_array_equal((np.asarray(frame.seg) == 0)[clear], (inside > 0)[clear])
    seen = clear & (inside > 0)
    assert seen.sum() > 50
    # 500 m are exact to 2e-3 m with the few bits of a rank.
    np.testing.assert_allclose(np.asarray(frame.depth)[seen], 500 - z[seen], atol=5e-3)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_thin_wedge_on_its_edge(renderer):
    """Two planes 2 degrees apart, cut at z = 0 and z = -1; its edge lies along y."""
    slope = np.tan(np.deg2rad(1.0))
    normals = [[1, 0, slope], [-1, 0, slope], [0, 0, -1], [0, 1, 0], [0, -1, 0]]
    scene = polytope(normals, [0, 0, 1, 0.5, 0.5])
    frame = render(scene.replace(camera=scenes.from_above(1.0, 90.0)), 31, 31, renderer)
    # The middle column looks along the wedge's plane of symmetry, onto its edge at depth 1.
    seen = np.asarray(frame.seg) == 0
    rows = np.flatnonzero(seen[:, 15])
    np.testing.assert_array_equal(rows, np.arange(8, 23))
    np.testing.assert_allclose(np.asarray(frame.depth)[rows, 15], 1.0, atol=1e-4)
    assert not seen[:, np.r_[:14, 17:31]].any()


@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_camera_inside_sees_nothing_of_it(renderer):
    inside = scenes.camera((0.1, 0.1, 0.1), (1.0, 0.5, 0.3))
    scene = scenes.one_geom(GeomKind.MESH, HALF, (0.0, -2.0, 0.0)).replace(camera=inside)
    frame = render(scene, 8, 8, renderer)
    assert (np.asarray(frame.seg) == -1).all()
    assert (np.asarray(frame.depth) == FAR).all()


def test_a_mesh_without_planes_is_told():
    scene = scenes.scene_of((GeomKind.MESH, (1.0, 0, 0), (0, 0, 0)))
    with pytest.raises(ValueError, match=r"'geom/0' is a mesh, .* set num_planes and planes"):
        render(scene, 4, 4)


def test_scenes_without_meshes_have_no_more_arrays():
    geoms = scenes.random_scene(0).geoms
    assert (geoms.num_planes, geoms.planes) == ((), None)
    assert not any("planes" in str(path) for path, _ in jax.tree.leaves_with_path(geoms))


MODEL = """
<mujoco>
  <asset>
    <mesh name="wedge" vertex="0 0 0  .6 0 0  0 .4 0  .6 .4 0  0 0 .3  0 .4 .3"/>
    <mesh name="tetra" vertex="0 0 0  .5 0 0  0 .5 0  0 0 .5" scale="1 1.2 .8"/>
  </asset>
  <worldbody>
    <geom name="ground" type="box" size="1 1 .1" pos="0 0 -.1"/>
    <body name="a" pos="-.4 0 .4" euler="20 30 40">
      <joint/><geom name="wedge" type="mesh" mesh="wedge" pos=".1 .2 0" euler="10 0 60"/>
    </body>
    <geom name="tetra" type="mesh" mesh="tetra" pos=".5 .1 .3" euler="200 10 0"/>
    <geom name="ball" size=".15" pos=".1 -.5 .2"/>
  </worldbody>
</mujoco>
"""


def opengl(model: mujoco.MjModel, data: mujoco.MjData, eye, target, size: int):
    """Geom ids or -1 and depths (size, size) of MuJoCo's renderer; skips where none is named."""
    way = np.subtract(target, eye)
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance = target, np.linalg.norm(way)
    camera.azimuth = np.rad2deg(np.arctan2(way[1], way[0]))
    camera.elevation = np.rad2deg(np.arcsin(way[2] / camera.distance))
    need_opengl()
    with mujoco.Renderer(model, size, size) as renderer:
        option = mujoco.MjvOption()
        option.sitegroup[:] = 0
        renderer.enable_segmentation_rendering()
        renderer.update_scene(data, camera, option)
        ids, kinds = np.moveaxis(renderer.render().copy(), -1, 0)
        renderer.disable_segmentation_rendering()
        renderer.enable_depth_rendering()
        renderer.update_scene(data, camera, option)
        depth = renderer.render().copy()
    return np.where(kinds == int(mujoco.mjtObj.mjOBJ_GEOM), ids, -1), depth


def rays(model: mujoco.MjModel, data: mujoco.MjData, eye, target, size: int):
    """The same by MuJoCo's ray caster, which hits the triangles of the meshes."""
    axes = look_at(*(jnp.array(v, jnp.float32) for v in (eye, target, (0, 0, 1))))
    return cast_rays(model, data, eye, axes, 45.0, size, size)


def compare(model: mujoco.MjModel, eye, target, size: int, oracle, renderer="fused"):
    """What of both images is a geom other than a plane, where they agree, and both depths."""
    model.vis.global_.fovy = 45.0
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    xpos, xquat = (np.float32(x[1:]) for x in (data.xpos, data.xquat))
    geoms = as_geoms(geom_shapes(model))
    rig, look = make_rig(eye, target, 45.0), make_look("default")
    frame = render(place(geoms, rig, look, xpos, xquat), size, size, renderer)
    ids, depth = oracle(model, data, eye, target, size)
    kinds = [mujoco.mjtGeom(int(k)).name.removeprefix("mjGEOM_").lower() for k in model.geom_type]
    names = [model.geom(g).name or f"{kind}/{g}" for g, kind in enumerate(kinds)]
    ours = np.array([*geoms.name, ""], object)[np.asarray(frame.seg)]
    theirs = np.array([*names, ""], object)[ids]
    planes = ["", *(name for name, kind in zip(names, kinds, strict=True) if kind == "plane")]
    things = ~np.isin(ours, planes), ~np.isin(theirs, planes)
    return *things, ours == theirs, np.asarray(frame.depth), depth


@pytest.mark.parametrize("oracle", [rays, opengl])
@pytest.mark.parametrize("renderer", RENDERERS)
def test_meshes_of_few_faces_are_those_of_mujoco(renderer, oracle):
    model = mujoco.MjModel.from_xml_string(MODEL)
    scene = read_scene(model)
    assert scene.geoms.num_planes == (0, 4, 0, 5)
    assert scene.hull_errors == {"wedge": 0.0, "tetra": 0.0}
    ours, theirs, same, depth, true_depth = compare(
        model, (1.2, -1.6, 1.1), (0, 0, 0.3), 64, oracle, renderer
    )
    assert theirs.mean() > 0.1
    # OpenGL's pixels at silhouettes may be others.
    assert same.mean() >= 0.99
    both = same & ours
    assert np.quantile(np.abs(depth[both] - true_depth[both]), 0.99) < 5e-3


def assert_alike(model: mujoco.MjModel, eye, target, oracle, covered: float) -> None:
    ours, theirs, *_ = compare(model, eye, target, 64, oracle, "reference")
    assert theirs.mean() > 0.02, "there is something to see"
    assert (ours & theirs).sum() / (ours | theirs).sum() > covered


def in_package(package: str, *path: str) -> mujoco.MjModel:
    """A model that comes with a package; skips without it."""
    found = find_spec(package)
    if found is None or found.origin is None:
        pytest.skip(f"{package} is not installed")
    return mujoco.MjModel.from_xml_path(str(Path(found.origin).parent.joinpath(*path)))


def test_a_robot_of_dm_control():
    """Kinova's arm, whose meshes have hundreds of facets and are not all convex."""
    model = in_package("dm_control", "third_party", "kinova", "jaco_arm.xml")
    errors = hull_errors(geom_shapes(model))
    assert len(errors) >= 6
    assert 1e-4 < max(errors.values()) < 0.01
    assert_alike(model, (0.9, -0.9, 0.8), (0, 0, 0.45), rays, 0.9)


@pytest.mark.parametrize(
    ("package", "path", "eye", "target"),
    [
        ("gymnasium_robotics", "envs/assets/fetch/reach.xml", (2.9, -0.6, 1.6), (0.8, 0.75, 0.6)),
        ("robosuite", "models/assets/robots/iiwa/robot.xml", (1.3, -1.3, 1.0), (0.1, 0.0, 0.5)),
    ],
)
def test_robots_of_other_packages(package, path, eye, target):
    assert_alike(in_package(package, *path.split("/")), eye, target, opengl, 0.85)
