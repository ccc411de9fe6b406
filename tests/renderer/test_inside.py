"""A camera inside a geom does not see it."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import GeomKind
from pixelbrax_jax.renderer.base import render
from tests.renderer.scenes import from_above, scene_of
from tests.renderer.test_planes import RENDERERS

SOLIDS = {
    GeomKind.SPHERE: (0.3, 0, 0),
    GeomKind.CAPSULE: (0.3, 0.5, 0),
    GeomKind.ELLIPSOID: (0.3, 0.4, 0.5),
    GeomKind.CYLINDER: (0.3, 0.5, 0),
    GeomKind.BOX: (0.3, 0.4, 0.5),
}
AXES = {
    "down": jnp.eye(3),
    "up": jnp.diag(jnp.array([1.0, -1.0, -1.0])),
    "along x": jnp.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
}


@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_camera_inside(renderer):
    solids = [(kind, size, (4.0 * i, 0, 1)) for i, (kind, size) in enumerate(SOLIDS.items())]
    scene = scene_of((GeomKind.PLANE, (0, 0, 1), (0, 0, 0)), *solids)
    for i, (_, _, middle) in enumerate(solids):
        for name, axes in AXES.items():
            for shift in ((0, 0, 0), (0.1, -0.1, 0.2)):
                pos = jnp.array(middle, jnp.float32) + jnp.array(shift)
                camera = from_above(1.0, fovy=90.0).replace(pos=pos, xmat=axes)
                seen = np.unique(render(scene.replace(camera=camera), 9, 9, renderer).seg)
                assert 1 + i not in seen
                assert name != "down" or 0 in seen
