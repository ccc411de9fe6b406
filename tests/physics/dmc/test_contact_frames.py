"""A capsule slides over a plane as in MuJoCo, however steep it is."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.mjx._src import collision_driver

from pixelbrax_jax.physics.mjx.dynamics import Dynamics

MODEL = """
<mujoco>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 1">
      <freejoint/>
      <geom type="capsule" size=".1 .3"/>
    </body>
  </worldbody>
</mujoco>
"""


def test_steep_capsules_slide_as_in_mujoco():
    model = mujoco.MjModel.from_xml_string(MODEL)
    random = np.random.RandomState(0)
    # Tilted by up to 30 degrees from upright, their lower ends 5 mm below the plane.
    tilt, turn = random.uniform(0.05, np.pi / 6, 40), random.uniform(0, 2 * np.pi, 40)
    half = np.sin(tilt / 2)
    quat = [np.cos(tilt / 2), half * np.cos(turn), half * np.sin(turn), np.zeros(40)]
    height = 0.3 * np.cos(tilt) + 0.1 - 0.005
    qpos = np.concatenate([np.zeros((40, 2)), height[:, None], np.stack(quat, axis=1)], axis=1)
    qvel = random.normal(size=(40, 6))
    before = dict(collision_driver._COLLISION_FUNC)
    dynamics = Dynamics(model)
    move = jax.jit(jax.vmap(lambda q, v: dynamics.step(dynamics.state(q, v), 1)[0].qvel))
    ours = move(jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32))
    assert before == collision_driver._COLLISION_FUNC
    for i in range(40):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        mujoco.mj_step(model, data)
        assert data.ncon == 1
        np.testing.assert_allclose(ours[i], data.qvel, atol=1e-3)
