"""Pictures of the DM Control Suite's models against MuJoCo: what is where, and how deep."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from pixelbrax_jax import make_look
from pixelbrax_jax.renderer.base import render
from pixelbrax_jax.scene.place import place
from tests.renderer import suite_models
from tests.renderer.mujoco_scene import cast

SIZE = 48
FAST = ("ball_in_cup", "finger", "manipulator", "walker")
"""A hanging string, a target that moves, a camera 16 m from fingers of 7 mm, one that tracks."""


def compare(domain: str, num_poses: int) -> None:
    suite = suite_models.load(domain)
    geoms, rig, look = suite.scene.geoms, suite.scene.rig, make_look("default")
    # Pieces of a string go by its name.
    names = ["/".join(n.split("/")[:2]) if n.startswith("tendon/") else n for n in geoms.name]
    planes = {n for n, kind in zip(names, geoms.kind, strict=True) if kind == 0}

    @jax.jit
    def draw(xpos, xquat):
        frame = render(place(geoms, rig, look, xpos, xquat), SIZE, SIZE)
        return frame.seg, frame.depth

    agree, on_things = [], []
    for xpos, xquat in suite.poses(num_poses):
        seg, depth = (np.asarray(plane) for plane in draw(xpos, xquat))
        seen, true_depth = cast(suite.model, suite.data, suite.camera, SIZE)
        same = np.array([*names, ""], dtype=object)[seg] == seen
        agree.append(same)
        on_things.append(same[(seen != "") & ~np.isin(seen, list(planes))])
        both = same & (seg >= 0)
        # A string's pieces are longer than MuJoCo's, and cut its bends short.
        error = np.abs(depth[both] / true_depth[both] - 1)
        assert error.max() < (5e-3 if geoms.strings else 1e-3)
    assert np.mean(agree) >= 0.995
    things = np.concatenate(on_things)
    assert len(things) > 2 * num_poses, "the poses show too little"
    assert things.mean() >= 0.97, f"{things.mean():.4f}"


@pytest.mark.parametrize("domain", FAST)
def test_geom_ids_and_depth_in_some_poses(domain):
    compare(domain, 2)


@pytest.mark.slow
@pytest.mark.parametrize("domain", suite_models.MODELS)
def test_geom_ids_and_depth_in_many_poses(domain):
    compare(domain, 20)
