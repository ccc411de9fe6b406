"""Sensors of positions and velocities, and of the kinetic energy, read what MuJoCo's own read."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pixelbrax_jax.physics.mujoco.mjcf import mjcf_physics

MODEL = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <camera name="view" pos="0 -3 1" xyaxes="1 0 0 0 0 1" resolution="64 48"/>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <site name="hook" pos="0 0 2"/>
    <body name="arm" pos="0 0 1">
      <joint name="arm" axis="0 1 0" limited="true" range="-1 1" margin=".2"
             solreflimit="1 1"/>
      <geom type="capsule" fromto="0 0 0 .4 0 0" size=".03" contype="0" conaffinity="0"/>
      <site name="hand" pos=".4 0 0"/>
    </body>
    <body name="ball" pos="1 0 .1">
      <freejoint name="ball"/>
      <geom name="ball" size=".1"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="wire" limited="true" range="-3 1.9" margin=".2" solreflimit="1 1">
      <joint joint="arm" coef="2"/>
    </fixed>
    <spatial name="rope"><site site="hook"/><site site="hand"/></spatial>
  </tendon>
  <actuator><position name="servo" joint="arm" gear="3" kp="5"/></actuator>
  <sensor>
    <jointpos joint="arm"/>
    <jointvel joint="arm"/>
    <tendonpos tendon="wire"/>
    <tendonpos tendon="rope"/>
    <tendonvel tendon="rope"/>
    <actuatorpos actuator="servo"/>
    <actuatorvel actuator="servo"/>
    <framepos objtype="camera" objname="view"/>
    <framepos objtype="site" objname="hand" reftype="camera" refname="view"/>
    <camprojection site="hand" camera="view"/>
    {limits}
  </sensor>
</mujoco>
"""
LIMITS = """
    <jointlimitpos joint="arm"/>
    <jointlimitvel joint="arm"/>
    <tendonlimitpos tendon="wire"/>
    <tendonlimitvel tendon="wire"/>
"""
"""MuJoCo XLA has none of these."""
CONTACT = '<contact geom1="ball" geom2="floor" num="1" data="found dist"/>'


@pytest.mark.parametrize(
    ("engine", "limits"),
    [("mujoco", LIMITS + CONTACT), pytest.param("xla", CONTACT, marks=pytest.mark.slow)],
)
def test_sensors_are_mujocos(engine, limits):
    xml = MODEL.format(limits=limits)
    physics = mjcf_physics(
        xml,
        reward=lambda before, after, action: 0.0,
        observe=lambda seen: seen.data.sensordata,
        reset_noise=0.0,
        n_frames=3,
        engine=engine,
    )
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    q = model.qpos0.astype(np.float32)
    # Within the margins of upper limits, and the ball in the floor.
    q[0], q[3] = 0.9, 0.099
    state = jax.jit(physics.from_qpos)(jnp.array(q), jnp.full(model.nv, 0.2))
    step, action = jax.jit(physics.step), jnp.array([0.5])
    data.qpos[:], data.qvel[:] = q, 0.2
    for _ in range(2):
        mujoco.mj_forward(model, data)
        assert (np.abs(data.sensordata) > 1e-9).sum() > data.sensordata.size - 4, "few are 0"
        # float32 positions, of a ball in the floor, move the contact a little.
        np.testing.assert_allclose(state.obs, data.sensordata, atol=1e-3, rtol=1e-3)
        state, data.ctrl[:] = step(state, action), action
        mujoco.mj_step(model, data, 3)


def test_kinetic_energy_is_that_of_the_row():
    """Half of v M v; MuJoCo's sensor keeps an earlier one if the model's flag is on."""
    flag = '<option timestep="0.002"><flag energy="enable"/></option>'
    xml = MODEL.format(limits="<e_kinetic/>").replace('<option timestep="0.002"/>', flag)
    physics = mjcf_physics(
        xml,
        reward=lambda before, after, action: 0.0,
        observe=lambda seen: seen.data.sensordata[-1:],
        reset_noise=0.0,
    )
    model = mujoco.MjModel.from_xml_string(xml)
    data, qpos = mujoco.MjData(model), jnp.tile(jnp.array(model.qpos0), (2, 1))
    for speeds in ((0.5, 5.0), (5.0, 0.5)):
        qvel = jnp.outer(jnp.array(speeds), jnp.ones(model.nv))
        found = jax.jit(jax.vmap(physics.from_qpos))(qpos, qvel).obs[:, 0]
        expected = []
        for speed in speeds:
            data.qvel[:] = speed
            mujoco.mj_forward(model, data)
            mujoco.mj_energyVel(model, data)
            expected.append(data.energy[1])
        np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_joints_have_all_their_numbers():
    xml = MODEL.format(limits="")
    physics = mjcf_physics(
        xml,
        reward=lambda before, after, action: 0.0,
        observe=lambda seen: jnp.concatenate(
            [seen.joint_pos("ball", "arm"), seen.joint_vel("arm", "ball")]
        ),
        reset_noise=0.0,
    )
    state = physics.from_qpos(
        jnp.array([0.3, 1.0, 2.0, 3.0, 0.6, 0.8, 0.0, 0.0]), jnp.arange(7.0) / 10
    )
    np.testing.assert_allclose(
        state.obs, [1, 2, 3, 0.6, 0.8, 0, 0, 0.3, *np.arange(7.0) / 10], atol=1e-6
    )
