"""Constraint forces are MuJoCo's."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.mjx._src import solver as theirs

from pixelbrax_jax._platform.interpreter import batch_last
from pixelbrax_jax.physics.mjx.dynamics import Dynamics
from pixelbrax_jax.physics.mjx.solver import is_supported

# Two arms with dry friction, limits and a joint that follows another; a ball that slides and rolls.
MODEL = """
<mujoco>
  <option solver="Newton" cone="{cone}" tolerance="1e-12" iterations="200"/>
  <default><geom density="500" condim="{arms}"/></default>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 .32">
      <joint name="a" axis="0 1 0" range="-40 40" limited="true" frictionloss=".4"/>
      <geom type="capsule" size=".05" fromto="0 0 0 .4 0 0"/>
      <body pos=".4 0 0">
        <joint name="b" axis="0 1 0" frictionloss=".05"/>
        <geom type="capsule" size=".05" fromto="0 0 0 .3 0 0"/>
      </body>
    </body>
    <body pos="0 1 1"><joint name="c" axis="0 0 1"/><geom type="box" size=".1 .2 .05"/></body>
    <body pos="1 1 .1"><freejoint/><geom type="sphere" size=".1" condim="{condim}"/></body>
  </worldbody>
  <equality><joint joint1="c" joint2="a" polycoef="0 2 0 0 0"/></equality>
</mujoco>
"""
NUM_STATES = 64


def model_of(cone, condim, *, arms):
    xml = MODEL.format(cone=cone, condim=condim, arms=arms)
    return mujoco.MjModel.from_xml_string(xml)


def states(model):
    """States with any mixture of constraints at work."""
    random = np.random.RandomState(0)
    qpos = np.tile(model.qpos0, (NUM_STATES, 1))
    qpos[:, :3] += random.uniform(-0.8, 0.8, (NUM_STATES, 3))
    qpos[:, 5] += random.uniform(-0.004, 0.002, NUM_STATES)
    return qpos, random.normal(size=(NUM_STATES, model.nv))


def last(function):
    return batch_last(function, (0, 0))


@pytest.mark.parametrize(
    ("cone", "condim", "batch"),
    [
        ("pyramidal", 1, jax.vmap),
        ("pyramidal", 3, jax.vmap),
        ("pyramidal", 3, last),
        ("elliptic", 3, jax.vmap),
        ("elliptic", 4, last),
        ("elliptic", 6, jax.vmap),
        *(
            pytest.param(cone, condim, batch, marks=pytest.mark.slow)
            for cone, condim, batch in (
                ("pyramidal", 1, last),
                ("elliptic", 3, last),
                ("elliptic", 4, jax.vmap),
                ("elliptic", 6, last),
            )
        ),
    ],
)
def test_forces_are_those_of_mujoco(cone, condim, batch):
    model = model_of(cone, condim, arms=max(condim, 3))
    assert is_supported(model)
    qpos, qvel = states(model)
    before = theirs.solve
    dynamics = Dynamics(model)
    move = batch(lambda q, v: dynamics.step(dynamics.state(q, v), 1)[0].qacc_warmstart)
    ours = jax.jit(move)(jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32))
    assert theirs.solve is before
    numbers, zones = set(), set()
    for i in range(NUM_STATES):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        mujoco.mj_forward(model, data)
        numbers.add((data.ne, data.nf, data.nl, data.ncon))
        zones |= set(data.efc_state.tolist())
        scale = np.maximum(1.0, np.abs(data.qacc).max())
        np.testing.assert_allclose(ours[i] / scale, data.qacc / scale, atol=1e-4)
    # All kinds of constraints were there, and not always the same ones.
    assert np.max(list(numbers), axis=0).min() > 0
    assert len(numbers) > 4
    slips = int(mujoco.mjtConstraintState.mjCNSTRSTATE_CONE) in zones
    assert slips == (cone == "elliptic")


def test_cones_of_several_dimensions_are_left_to_mujoco_xla():
    assert not is_supported(model_of("elliptic", 4, arms=3))
