"""Scenes that the renderer's tests share."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np

from pixelbrax_jax import Camera, GeomKind, Geoms, Look, make_look
from pixelbrax_jax.spatial import look_at
from pixelbrax_jax.types import FAR, Scene

PRIMITIVES_MJCF = """
<mujoco>
  <worldbody>
    <geom name="ground" type="plane" size="0 0 1"/>
    <geom name="ball" type="sphere" size="0.3"/>
    <geom name="pill" type="capsule" size="0.15 0.35"/>
    <geom name="egg" type="ellipsoid" size="0.2 0.45 0.3"/>
    <geom name="can" type="cylinder" size="0.25 0.3"/>
    <geom name="brick" type="box" size="0.2 0.35 0.15"/>
  </worldbody>
</mujoco>
"""


def primitives() -> mujoco.MjModel:
    """One geom of every kind that can be drawn, but no mesh."""
    return mujoco.MjModel.from_xml_string(PRIMITIVES_MJCF)


def geoms_of(kinds, sizes, names=None, **static) -> Geoms:
    """Geoms on no link, each with a color of its own."""
    count = len(kinds)
    return Geoms(
        kind=tuple(int(kind) for kind in kinds),
        link=(-1,) * count,
        material=tuple(range(count)),
        name=tuple(names or (f"geom/{g}" for g in range(count))),
        size=jnp.asarray(sizes, jnp.float32),
        pos=jnp.zeros((count, 3)),
        quat=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (count, 1)),
        rgb=jnp.linspace(0.2, 0.9, 3 * count).reshape(count, 3),
        **static,
    )


def scene_of(*solids, look=None, camera=None, **static) -> Scene:
    """A scene of (kind, size, position), axes along the world's, seen from above."""
    kinds, sizes, positions = zip(*solids, strict=True)
    return Scene(
        geoms=geoms_of(kinds, sizes, **static),
        pos=jnp.array(positions, jnp.float32),
        xmat=jnp.tile(jnp.eye(3), (len(kinds), 1, 1)),
        camera=camera or from_above(2.0),
        look=look or make_look("default"),
    )


def from_above(height, fovy=60.0) -> Camera:
    """A camera that looks straight down, x right and y up in its image."""
    pos = jnp.array([0.0, 0.0, height], jnp.float32)
    return Camera(pos=pos, xmat=jnp.eye(3), fovy=jnp.float32(fovy))


def camera(eye, target=(0.0, 0.0, 0.5), fovy=50.0) -> Camera:
    """A camera that looks at a point."""
    eye, target = jnp.array(eye, jnp.float32), jnp.array(target, jnp.float32)
    up = jnp.array([0.0, 0.0, 1.0])
    return Camera(pos=eye, xmat=look_at(eye, target, up), fovy=jnp.float32(fovy))


def random_scene(seed: int, look: Look | None = None) -> Scene:
    """All primitives at random poses above the ground, seen from a random side."""
    rng = np.random.default_rng(seed)
    model = primitives()
    count = model.ngeom
    names = [model.geom(g).name for g in range(count)]
    geoms = geoms_of(model.geom_type, model.geom_size, names)
    pos = rng.uniform([-0.8, -0.8, 0.1], [0.8, 0.8, 1.1], (count, 3))
    quat = rng.normal(size=(count, 4))
    pos[0], quat[0] = 0.0, (1.0, 0.0, 0.0, 0.0)
    xmat = np.zeros((count, 9))
    for g in range(count):
        mujoco.mju_quat2Mat(xmat[g], quat[g] / np.linalg.norm(quat[g]))
    side = rng.uniform(0, 2 * np.pi)
    eye = (3.0 * np.cos(side), 3.0 * np.sin(side), rng.uniform(0.5, 2.5))
    return Scene(
        geoms=geoms,
        pos=jnp.asarray(pos, jnp.float32),
        xmat=jnp.asarray(xmat.reshape(count, 3, 3), jnp.float32),
        camera=camera(eye),
        look=look or make_look("default"),
    )


def one_geom(kind: int, size, eye, *, pos=(0.0, 0.0, 0.0), target=(0.0, 0.0, 0.0), fovy=40.0):
    """A scene with a single geom, axes along the world's; a mesh is a box."""
    planes = {"planes": box_planes(size), "num_planes": (6,)} if kind == GeomKind.MESH else {}
    return scene_of((kind, size, pos), camera=camera(eye, target, fovy), **planes)


def box_planes(half) -> jnp.ndarray:
    """Half-spaces of a box, as a mesh has them."""
    normals = np.concatenate([np.eye(3), -np.eye(3)])
    return jnp.asarray(np.column_stack([normals, [*half, *half]]), jnp.float32)


def assert_alike(one, other, colors: float) -> None:
    """Two images are the same, but for single pixels at silhouettes and edges of shadows."""
    same = np.asarray(one.seg == other.seg)
    assert same.mean() > 0.998
    np.testing.assert_array_equal(one.ground[same], other.ground[same])
    difference = np.max([np.abs(getattr(one, c) - getattr(other, c)) for c in "rgb"], axis=0)
    assert np.mean(difference > 2 / 255) < colors
    both = same & (other.depth < FAR)
    np.testing.assert_allclose(one.depth[both], other.depth[both], rtol=1e-3)
