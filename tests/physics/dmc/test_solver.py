"""Our parts of a step: constraint forces, contacts and linear equations are MuJoCo's."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from pixelbrax_jax._platform.folding import fold
from pixelbrax_jax._platform.interpreter import batch_last
from pixelbrax_jax.physics.mujoco import elimination, stages
from pixelbrax_jax.physics.mujoco.needs import Needs
from pixelbrax_jax.physics.mujoco.stages import is_supported
from pixelbrax_jax.physics.mujoco.xla import Mjx, Xla

# Two arms with dry friction, damping, limits, a brake and a joint that follows another; a ball that
# slides and rolls.
MODEL = """
<mujoco>
  <option solver="Newton" cone="{cone}" tolerance="1e-12" iterations="200"/>
  <default><geom density="500" condim="{arms}"/></default>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 .32">
      <joint name="a" axis="0 1 0" range="-40 40" limited="true" frictionloss=".4" damping=".3"/>
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
  <actuator><velocity joint="b" kv=".2"/></actuator>
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


def after_a_step(model, qpos, qvel, batch=jax.vmap, kind=Xla):
    """Our ``qpos, qvel, act, qacc`` after a step."""
    engine = kind(model, Needs())
    rest = [jnp.zeros(size) for size in (model.na, model.nv, model.nu, 0)]
    move = batch(lambda q, v: engine.step(1, q, v, *rest)[:4])
    return jax.jit(move)(jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32))


def mujocos(model, qpos, qvel, function):
    """MuJoCo's data of each state after ``function``."""
    for q, v in zip(qpos, qvel, strict=True):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = q, v
        function(model, data)
        yield data


@pytest.mark.parametrize(
    ("cone", "condim", "batch"),
    [
        pytest.param("pyramidal", 1, jax.vmap, marks=pytest.mark.slow),
        pytest.param("pyramidal", 1, last, marks=pytest.mark.slow),
        pytest.param("pyramidal", 3, jax.vmap, marks=pytest.mark.slow),
        pytest.param("pyramidal", 3, last, marks=pytest.mark.slow),
        pytest.param("elliptic", 3, jax.vmap, marks=pytest.mark.slow),
        ("elliptic", 3, last),
        pytest.param("elliptic", 4, jax.vmap, marks=pytest.mark.slow),
        pytest.param("elliptic", 4, last, marks=pytest.mark.slow),
        pytest.param("elliptic", 6, jax.vmap, marks=pytest.mark.slow),
        pytest.param("elliptic", 6, last, marks=pytest.mark.slow),
    ],
)
def test_forces_are_those_of_mujoco(cone, condim, batch):
    model = model_of(cone, condim, arms=max(condim, 3))
    assert is_supported(model)
    qpos, qvel = states(model)
    ours = after_a_step(model, qpos, qvel, batch)[3]
    numbers, zones = set(), set()
    for found, data in zip(ours, mujocos(model, qpos, qvel, mujoco.mj_forward), strict=True):
        numbers.add((data.ne, data.nf, data.nl, data.ncon))
        zones |= set(data.efc_state.tolist())
        scale = np.maximum(1.0, np.abs(data.qacc).max())
        np.testing.assert_allclose(found / scale, data.qacc / scale, atol=1e-4)
    # All kinds of constraints were there, and not always the same ones.
    assert np.max(list(numbers), axis=0).min() > 0
    assert len(numbers) > 4
    slips = int(mujoco.mjtConstraintState.mjCNSTRSTATE_CONE) in zones
    assert slips == (cone == "elliptic")


def test_forms_for_a_gpu_give_the_same(monkeypatch):
    def for_cuda(*arguments, default, cpu, cuda=None):
        used.add(cpu.__name__)
        return (cuda or default)(*arguments)

    used = set()
    monkeypatch.setattr(jax.lax, "platform_dependent", for_cuda)
    model = model_of("pyramidal", 3, arms=3)
    qpos, qvel = states(model)
    ours = after_a_step(model, qpos, qvel, lambda step: jax.vmap(fold(step)))[3]
    assert used == {"by_pieces", "eliminate"}
    for found, data in zip(ours, mujocos(model, qpos, qvel, mujoco.mj_forward), strict=True):
        scale = np.maximum(1.0, np.abs(data.qacc).max())
        np.testing.assert_allclose(found / scale, data.qacc / scale, atol=1e-4)


def test_cones_of_several_dimensions_are_left_to_mujoco_xla():
    assert not is_supported(model_of("elliptic", 4, arms=3))


STEEP = """
<mujoco>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 1"><freejoint/><geom type="capsule" size=".1 .3"/></body>
  </worldbody>
</mujoco>
"""


def test_steep_capsules_slide_as_in_mujoco():
    model = mujoco.MjModel.from_xml_string(STEEP)
    random = np.random.RandomState(0)
    # Tilted by up to 30 degrees from upright, their lower ends 5 mm below the plane.
    tilt, turn = random.uniform(0.05, np.pi / 6, 40), random.uniform(0, 2 * np.pi, 40)
    half = np.sin(tilt / 2)
    quat = [np.cos(tilt / 2), half * np.cos(turn), half * np.sin(turn), np.zeros(40)]
    height = 0.3 * np.cos(tilt) + 0.1 - 0.005
    qpos = np.concatenate([np.zeros((40, 2)), height[:, None], np.stack(quat, axis=1)], axis=1)
    qvel = random.normal(size=(40, 6))
    ours = after_a_step(model, qpos, qvel)[1]
    for found, data in zip(ours, mujocos(model, qpos, qvel, mujoco.mj_step), strict=True):
        assert data.ncon == 1
        np.testing.assert_allclose(found, data.qvel, atol=1e-3)


# On a GPU the humanoid's 27 unknowns are eliminated in a loop, fewer without one, few at once.
@pytest.mark.parametrize(
    ("solve", "unknowns", "batch"),
    [
        *(
            (elimination.solve, unknowns, batch)
            for unknowns in (1, 3, elimination.LARGEST, elimination.LARGEST + 1)
            for batch in (jax.vmap, last)
        ),
        *(
            (elimination.on_cuda, unknowns, jax.vmap)
            for unknowns in (1, 2, elimination.IN_ONE_KERNEL, elimination.IN_ONE_KERNEL + 1)
        ),
        (elimination.on_cuda, 27, jax.vmap),
    ],
)
def test_solutions_are_numpys(solve, unknowns, batch):
    random = np.random.default_rng(unknowns)
    root = random.normal(size=(32, unknowns, unknowns))
    scale = 10.0 ** random.uniform(-1, 1, (32, unknowns, 1))  # As masses of fingers and torsos.
    matrix = scale * (root @ root.mT + np.eye(unknowns)) * scale.mT
    right = random.normal(size=(32, unknowns))
    found = jax.jit(batch(solve))(jnp.asarray(matrix, jnp.float32), jnp.asarray(right, jnp.float32))
    expected = np.linalg.solve(matrix, right[..., None])[..., 0]
    error = np.abs(found - expected).max(axis=1) / np.abs(expected).max(axis=1)
    assert error.max() < 1e-3
    assert np.median(error) < 1e-5


@pytest.mark.parametrize(
    ("solve", "unknowns"),
    [
        (elimination.solve, 2),
        (elimination.solve, elimination.LARGEST + 1),
        (elimination.on_cuda, 3),
    ],
)
def test_matrices_of_other_kinds_have_no_solution(solve, unknowns):
    matrix = jnp.diag(jnp.ones(unknowns).at[1].set(-1.0))
    assert jnp.isnan(solve(matrix, jnp.ones(unknowns))).all()


STAGES = ("collide", "solve", "_solve_inertia")


@pytest.mark.parametrize(
    "integrator",
    [
        "Euler",
        pytest.param("RK4", marks=pytest.mark.slow),
        pytest.param("implicitfast", marks=pytest.mark.slow),
    ],
)
def test_each_stage_of_our_own_is_used_and_agrees_with_mujoco_xlas(integrator, monkeypatch):
    xml = MODEL.format(cone="pyramidal", condim=3, arms=3)
    model = mujoco.MjModel.from_xml_string(
        xml.replace("<option", f'<option integrator="{integrator}"')
    )
    used = []
    for name in STAGES:
        monkeypatch.setattr(stages, name, recorded(getattr(stages, name), used))
    qpos, qvel = states(model)
    ours = after_a_step(model, qpos, qvel)
    assert set(used) == {*STAGES}
    theirs = after_a_step(model, qpos, qvel, kind=Mjx)
    for one, other in zip(ours[:2], theirs[:2], strict=True):
        scale = np.maximum(1.0, np.abs(other).max(axis=1, keepdims=True))
        far = (np.abs(one - other) / scale).max(axis=1)
        assert np.quantile(far, 0.9) < 1e-3


def recorded(function, used):
    def record(*args):
        used.append(function.__name__)
        return function(*args)

    return record
