"""The tip of the inverted double pendulum, where Brax before 0.12.3 had it wrong."""

import numpy as np
import pytest

from pixelbrax_jax.tasks import BRAX_TASKS

TASK = "inverted_double_pendulum"
# (cart, first hinge, second hinge) -> tip (x, z); agrees with MuJoCo's site "tip".
TIPS = [
    ((0, 0, 0), (0, 1.2)),
    ((0, 0, np.pi / 2), (0.6, 0.6)),
    ((0, 0, np.pi), (0, 0)),
    ((0, 0.3, -0.3), (0.1773, 1.1732)),
    ((0.2, 0.5, 0.7), (1.0469, 0.7440)),
]
backends = pytest.mark.parametrize(
    "backend",
    [
        pytest.param(
            name, marks=() if name == BRAX_TASKS[TASK].default_backend else pytest.mark.slow
        )
        for name in BRAX_TASKS[TASK].backends
    ],
)


def tip_of(physics, state, geom_pose):
    """Center of the far end cap of the upper pole, as an image shows it."""
    index = physics.geoms.name.index("cpole2")
    pos, mat = geom_pose(physics.geoms, state, index)
    half = float(physics.geoms.size[index, 1])
    ends = [pos + mat[:, 2] * half, pos - mat[:, 2] * half]
    hinge = np.asarray(state.xpos[physics.link_names.index("pole2")])
    return max(ends, key=lambda end: np.linalg.norm(end - hinge))


@backends
def test_tip(backend, program, geom_pose):
    compiled = program(TASK, backend)
    for q, (x, z) in TIPS:
        state = compiled.from_qpos(np.array(q, np.float32))
        tip = tip_of(compiled.physics, state, geom_pose)
        np.testing.assert_allclose(tip, [x, 0, z], atol=1e-4, err_msg=str(q))


@backends
def test_fallen_upper_pole_ends_the_episode_without_a_bonus(backend, program, geom_pose):
    compiled = program(TASK, backend)
    fallen = compiled.from_qpos(np.array([0, 0, np.pi / 2], np.float32))
    assert not fallen.terminated
    state = compiled.step(fallen, np.zeros(1, np.float32))
    assert state.terminated
    assert not state.non_finite
    assert state.reward < 0
    np.testing.assert_allclose(
        state.reward, reward(compiled.physics, state, geom_pose, alive=0), atol=1e-4
    )


@backends
def test_upright_pole_earns_the_bonus(backend, program, geom_pose):
    compiled = program(TASK, backend)
    upright = compiled.from_qpos(np.array([0, 0.01, 0.02], np.float32))
    state = compiled.step(upright, np.full(1, 0.1, np.float32))
    assert not state.terminated
    np.testing.assert_allclose(
        state.reward, reward(compiled.physics, state, geom_pose, alive=10), atol=1e-4
    )


def reward(physics, state, geom_pose, alive):
    x, _, z = tip_of(physics, state, geom_pose)
    _, v1, v2 = np.asarray(state.engine.pipeline.qd)
    return alive - (0.01 * x**2 + (z - 2) ** 2) - (1e-3 * v1**2 + 5e-3 * v2**2)
