"""Brax's fluid forces, which current JAX rejects, work and agree with MuJoCo's."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pixelbrax_jax.physics.brax.engine import fluid
from pixelbrax_jax.physics.mujoco.compatibility import accept_old_clip


def test_fluid_force_is_mujocos(program, unfused_model):
    model = unfused_model("swimmer")
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    compiled = program("swimmer")
    system = compiled.physics._env.unwrapped.sys

    @jax.jit
    def force(pipeline):
        inertia = system.link.inertia
        frc = fluid.force(
            system, pipeline.x, pipeline.cd, inertia.mass, inertia.i, pipeline.root_com
        )
        return frc.ang, frc.vel

    assert model.opt.density > 0
    assert model.opt.viscosity > 0
    for _ in range(3):
        q, qd = rng.uniform(-1, 1, 5), rng.uniform(-3, 3, 5)
        data.qpos[:], data.qvel[:] = q, qd
        mujoco.mj_forward(model, data)
        state = compiled.from_qpos(q.astype(np.float32), qd.astype(np.float32))
        torques, forces = map(np.asarray, force(state.engine.pipeline))
        joint_force = np.zeros(model.nv)
        for link in range(model.nbody - 1):
            mujoco.mj_applyFT(
                model,
                data,
                forces[link].astype(float),
                torques[link].astype(float),
                data.xipos[link + 1],
                link + 1,
                joint_force,
            )
        scale = np.abs(data.qfrc_passive).max()
        assert scale > 1
        np.testing.assert_allclose(joint_force, data.qfrc_passive, atol=1e-4 * scale)


def test_the_change_reaches_one_module():
    assert fluid.jp is not jnp
    accept_old_clip(fluid)  # again: changes nothing
    assert fluid.jp.clip(jnp.array(-1.0), a_min=0.5) == 0.5
    assert fluid.jp.clip(jnp.array(3.0), None, 2.0) == 2
    assert fluid.jp.sqrt is jnp.sqrt
    with pytest.raises(TypeError, match="a_min"):
        jnp.clip(jnp.array(1.0), a_min=0)
