"""A model of the user's moves as MuJoCo moves it, by both engines."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pixelbrax_jax.physics.mujoco.mjcf import mjcf_physics

SECONDS = 0.5

# Joints on a common body, off its origin, oblique; springs, rotors and dampers that explicit
# damping would not survive; actuators with gears, feedback and limits; a fluid; and a door that
# hits its stop, which has a margin and a time constant shorter than two steps.
TREE = """
<mujoco>
  <option timestep=".005" density="200" viscosity=".05"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="root" pos="0 0 1">
      <joint name="x" type="slide" axis="1 0 0" damping="1"/>
      <joint name="z" type="slide" axis="0 0 1" stiffness="60" damping=".5"/>
      <joint name="pitch" axis="0 1 0" armature=".05"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".04"/>
      <body name="arm" pos=".3 0 0" euler="10 0 20">
        <joint name="a" axis="0 1 0" pos=".02 0 .01" damping=".05"/>
        <joint name="b" axis="1 1 0" pos=".02 0 .01"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
        <body name="hand" pos=".3 0 0">
          <joint name="stiff" axis="0 0 1" damping="5"/>
          <geom type="ellipsoid" size=".06 .03 .02" pos=".05 0 0"/>
        </body>
      </body>
    </body>
    <body name="door" pos="0 2 1">
      <joint name="door" axis="0 0 1" range="-20 20" margin=".05" solreflimit=".002 1"/>
      <geom type="box" size=".2 .02 .2" pos=".2 0 0"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="door" gear="30" ctrlrange="-1 1"/>
    <motor joint="pitch" gear="3" ctrlrange="-1 1"/>
    <position joint="a" kp="5" kv=".2" gear="2" forcerange="-1 1" ctrlrange="-1 1"/>
    <velocity joint="b" kv=".3" ctrlrange="-1 1"/>
    <motor joint="x" ctrlrange="-3 1"/>
    <motor joint="z"/>
  </actuator>
</mujoco>
"""

# A ball thrown onto the ground and a box that slides to rest on it, both pushed; one pair of geoms
# that MuJoCo would not try of itself, and one that it would.
CONTACTS = """
<mujoco>
  <option timestep=".004"/>
  <worldbody>
    <geom name="ground" type="plane" size="5 5 1" friction=".6"/>
    <body pos="0 0 .15">
      <joint name="ball" type="free" damping=".01"/>
      <geom name="ball" size=".1" solref=".004 1"/>
    </body>
    <body pos="0 1 .11">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <joint name="lift" type="slide" axis="0 0 1"/>
      <geom name="box" type="box" size=".1 .1 .1" friction=".3" contype="0" conaffinity="0"/>
      <geom name="horn" size=".1" pos="0 -1 .6" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <contact><pair geom1="ground" geom2="box"/></contact>
  <actuator>
    <motor joint="slide" gear="20" ctrlrange="-1 1"/>
    <motor joint="ball" gear="5 0 0 0 0 0" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""

MODELS = {"tree": TREE, "contacts": CONTACTS}
TOLERANCE = {"mujoco": 1e-5, "xla": 1e-3}
"""Metres and radians, of movements of half a metre and a radian; as docs/howto/own-task.md has
them."""


@pytest.mark.parametrize("engine", ["mujoco", pytest.param("xla", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", MODELS)
def test_motion(name, engine):
    model = mujoco.MjModel.from_xml_string(MODELS[name])
    physics = mjcf_physics(MODELS[name], reward=lambda *_: jnp.zeros(()), n_frames=1, engine=engine)
    # An action is between the ends of the control range, or the control where there is none.
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = np.where(limited, model.actuator_ctrlrange.T, [[-1.0], [1.0]])
    steps = round(SECONDS / model.opt.timestep)
    actions = np.where(np.arange(steps)[:, None] < steps // 2, 0.7, -0.4) * np.ones(model.nu)
    start = np.full(model.nv, 0.3)
    data = mujoco.MjData(model)
    data.qvel[:] = start
    expected = []
    for action in actions:
        data.ctrl[:] = low + (action + 1) / 2 * (high - low)
        mujoco.mj_step(model, data)
        expected.append(np.array(data.qpos))

    def roll(q, qd, actions):
        state = physics.from_qpos(q, qd)

        def step(state, action):
            state = physics.step(state, action)
            return state, state.obs[: model.nq]

        return jax.lax.scan(step, state, actions)[1]

    roll = jax.jit(roll, compiler_options={"xla_backend_optimization_level": 0})
    found = roll(model.qpos0, start, np.asarray(actions, np.float32))
    moved = np.ptp(expected, axis=0)
    assert moved[:6].min() > 5e-3
    tolerance = TOLERANCE[engine]
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)
