"""The image's geometry against MuJoCo's ray caster, which shares no code with ours."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from brax.io import mjcf
from etils import epath

import pixelbrax_jax
from pixelbrax_jax.renderer.base import render
from pixelbrax_jax.scene.place import place
from pixelbrax_jax.tasks import BRAX_TASKS
from pixelbrax_jax.types import FAR
from tests.renderer import scenes
from tests.renderer.mujoco_rays import cast

SIZE = 32
NUM_POSES = 20
RENDERERS = ("fused", pytest.param("pallas", marks=pytest.mark.slow))

pytestmark = pytest.mark.usefixtures("interpreted")


def compare(model: mujoco.MjModel, batch, shown: list[int], renderer: str) -> None:
    frames = jax.jit(jax.vmap(lambda scene: render(scene, SIZE, SIZE, renderer)))(batch)
    same, depths, seen = [], [], 0
    for i in range(NUM_POSES):
        scene = jax.tree.map(lambda x, i=i: x[i], batch)
        seg, depth = cast(model, scene, shown, SIZE, SIZE)
        agree = np.asarray(frames.seg[i]) == seg
        both = agree & (seg >= 0)
        same.append(agree.mean())
        depths.append(np.abs(np.asarray(frames.depth[i])[both] / depth[both] - 1).max(initial=0))
        assert ((np.asarray(frames.depth[i]) == FAR) == (np.asarray(frames.seg[i]) < 0)).all()
        seen += len(np.unique(seg[seg >= 0]))
    # Differences are allowed on silhouettes and on surfaces that coincide.
    assert np.mean(same) >= 0.995, f"geom ids agree on {np.mean(same):.4%} of the pixels"
    assert min(same) >= 0.985
    assert max(depths) <= 1e-3
    assert seen >= 2 * NUM_POSES, "the poses show too little to compare"


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize(
    "task",
    [pytest.param(t, marks=() if t in ("ant", "pusher") else pytest.mark.slow) for t in BRAX_TASKS],
)
def test_task_at_random_poses(task, renderer):
    _, params = pixelbrax_jax.make(task)
    name = {"halfcheetah": "half_cheetah"}.get(task, task)
    model = mjcf.load_mjmodel(epath.resource_path("brax") / f"envs/assets/{name}.xml")
    shown = [g for g in range(model.ngeom) if model.geom_rgba[g, 3] > 0]
    assert len(shown) == len(params.geoms.kind)

    # Poses from MuJoCo's kinematics as well; its body i + 1 is link i.
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    xpos, xquat = [], []
    for _ in range(NUM_POSES):
        data.qpos[:] = model.qpos0 + rng.uniform(-0.4, 0.4, model.nq)
        mujoco.mj_kinematics(model, data)
        xpos.append(data.xpos[1:].astype(np.float32))
        xquat.append(data.xquat[1:].astype(np.float32))
    dress = partial(place, params.geoms, params.rig, params.look)
    compare(model, jax.jit(jax.vmap(dress))(np.stack(xpos), np.stack(xquat)), shown, renderer)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_every_primitive(renderer):
    model = scenes.primitives()
    batch = jax.tree.map(
        lambda *leaves: jnp.stack(leaves), *[scenes.random_scene(s) for s in range(NUM_POSES)]
    )
    compare(model, batch, list(range(model.ngeom)), renderer)
