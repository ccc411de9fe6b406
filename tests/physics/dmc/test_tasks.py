"""Names, errors and episodes of the DM Control Suite's tasks."""

from __future__ import annotations

import importlib.util
import itertools
import re
from functools import partial
from importlib import metadata

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax.extend import core
from mujoco.mjx._src import collision_driver

import pixelbrax_jax as pb
from pixelbrax_jax.physics.dmc import models
from pixelbrax_jax.physics.mujoco.elimination import LARGEST
from pixelbrax_jax.physics.mujoco.stages import is_supported
from pixelbrax_jax.registry import make_physics
from pixelbrax_jax.tasks import BRAX_TASKS, DMC_TASKS
from tests.physics.dmc import oracle
from tests.physics.dmc.test_against_dm_control import FAST
from tests.platform.equations import equations

EACH = [
    pytest.param(
        task,
        marks=()
        if task == "dmc_ball_in_cup_catch"
        else [pytest.mark.slow, pytest.mark.timeout(1800)],
    )
    for task in DMC_TASKS
]

needs_models = pytest.mark.skipif(
    importlib.util.find_spec("dm_control") is None, reason="dm_control is not installed"
)


def test_suites_are_listed_apart():
    assert pb.list_envs(suite="dmc") == tuple(sorted(DMC_TASKS))
    assert pb.list_envs(suite="brax") == tuple(sorted(BRAX_TASKS))
    assert len(DMC_TASKS) == 30
    with pytest.raises(ValueError, match="allowed: brax, dmc"):
        pb.list_envs(suite="dm_control")


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("cheetah_run", "dmc_cheetah_run"),
        ("cheetah-run", "dmc_cheetah_run"),
        ("dmc-cheetah-run", "dmc_cheetah_run"),
        ("hopper-hop", "dmc_hopper_hop"),
        ("Ball_In_Cup-Catch", "dmc_ball_in_cup_catch"),
        ("swimmer6", "dmc_swimmer_swimmer6"),
        ("PixelBrax/DMC-CheetahRun-v0", "dmc_cheetah_run"),
    ],
)
def test_other_libraries_names_are_understood(given, meant):
    with pytest.raises(ValueError, match=rf"Did you mean '{meant}'\? Allowed: "):
        pb.make(given)


def test_the_models_cameras_have_names():
    assert list(pb.named_rigs("dmc_cheetah_run")) == ["default", "side", "front", "top", "back"]
    rigs = pb.named_rigs("dmc_cheetah_run")
    np.testing.assert_array_equal(rigs["side"].eye, rigs["default"].eye)  # the model's camera 0
    with pytest.raises(TypeError, match="got 0; names: back, default, front, side, top"):
        pb.make("dmc_cheetah_run", camera=0)


def test_without_dm_control_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(models, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r'try: pip install "pixelbrax\[dmc\]"'):
        models.load_spec("cheetah")
    # Another way for Pythons without wheels.
    monkeypatch.setattr(models.sys, "version_info", (3, 13, 0))
    with pytest.raises(ImportError, match="pip install --no-deps dm_control"):
        models.load_spec("cheetah")


@needs_models
def test_other_models_are_warned_of_once(monkeypatch):
    monkeypatch.setattr(models, "_warned", [])
    monkeypatch.setitem(models.KNOWN_MODELS, "pendulum", "another")
    both = rf"dm_control {metadata.version('dm_control')} .* dm_control {models.KNOWN_VERSION}"
    with pytest.warns(UserWarning, match=both):
        models.load_spec("pendulum")
    models.load_spec("pendulum")


@pytest.mark.parametrize("option", [{"reward_preset": "paper"}, {"backend": "mjx"}])
def test_options_of_braxs_tasks_are_refused_by_name(option):
    ((name, value),) = option.items()
    message = f"{name}='{value}' is only for Brax's tasks, not for task 'dmc_cartpole_swingup'"
    with pytest.raises(ValueError, match=message):
        pb.make("dmc_cartpole_swingup", **option)


@needs_models
def test_equal_tasks_are_equal():
    task, other, _ = FAST
    assert make_physics(task) == make_physics(task)
    assert hash(make_physics(task)) == hash(make_physics(task))
    assert make_physics(task) != make_physics(other)


@needs_models
@pytest.mark.parametrize("task", EACH)
def test_episodes_are_truncated_after_1000_control_steps(task):
    env, params = pb.make(task, obs_mode="state")
    state, _ = env.reset(jax.random.key(0), params)
    actions = jax.random.uniform(jax.random.key(1), (1001, env.action_size), minval=-1.0)

    def step(state, action):
        state, timestep = env.step(state, action, params)
        return state, (timestep.terminated, timestep.truncated)

    _, (terminated, truncated) = jax.jit(lambda s: jax.lax.scan(step, s, actions))(state)
    assert not jnp.any(terminated)
    assert int(jnp.argmax(truncated)) == 999


@needs_models
@pytest.mark.parametrize("task", [task for task in DMC_TASKS if "finger" in task])
def test_what_the_finger_cannot_reach_is_not_tried(dm_control, task):
    theirs = oracle.load(task).physics.model
    ours = make_physics(task).dynamics.xla.simulated
    pairs = set(geom_pairs(theirs.ptr)) - set(geom_pairs(ours))
    assert len(geom_pairs(ours)) == 2
    data = mujoco.MjData(theirs.ptr)
    nearest = np.inf
    for qpos in itertools.product(np.linspace(-np.pi, np.pi, 17), repeat=3):
        data.qpos = qpos
        mujoco.mj_kinematics(theirs.ptr, data)
        for one, other in pairs:
            apart = mujoco.mj_geomDistance(theirs.ptr, data, one, other, 1.0, None)
            nearest = min(nearest, apart)
    assert nearest > 0.0089  # metres: between the tip and the axle of what it turns


def geom_pairs(model):
    return [(int(a), int(b)) for a, b, _ in collision_driver.geom_pairs(model)]


@needs_models
@pytest.mark.parametrize(
    "task",
    [
        pytest.param(task, marks=() if row.domain in ("humanoid", "finger") else pytest.mark.slow)
        for task, row in {row.domain: (task, row) for task, row in DMC_TASKS.items()}.values()
    ],
)
def test_a_step_factorises_one_matrix_after_the_other(task):
    """Threads of jaxlib 0.10 wait for each other otherwise: 128 humanoids never moved."""
    dynamics = make_physics(task).dynamics
    sizes = [getattr(dynamics.model, name) for name in ("nq", "nv", "na", "nv", "nu")] + [0]
    state = [jax.ShapeDtypeStruct((size,), jnp.float32) for size in sizes]
    step = jax.jit(partial(dynamics.xla.step, 1)).trace(*state)
    if dynamics.model.nv > LARGEST:
        assert count_factorised(step.jaxpr.jaxpr) > 1
        assert_in_turn(step.jaxpr.jaxpr)
    if is_supported(dynamics.model):
        # XLA captures no factorization in a CUDA graph.
        for platform in ("cuda", *(("cpu",) if dynamics.model.nv <= LARGEST else ())):
            program = step.lower(lowering_platforms=(platform,)).as_text()
            assert not re.search("cholesky|potrf", program)


def count_factorised(jaxpr):
    return sum(eqn.primitive.name in ("cholesky", "lu", "qr") for eqn in equations(jaxpr))


def assert_in_turn(jaxpr):
    """Each equation that factorises needs what the one before it found."""
    found = set()
    for eqn in jaxpr.eqns:
        inner = list(core.jaxprs_in_params(eqn.params))
        needs = not found.isdisjoint(v for v in eqn.invars if isinstance(v, core.Var))
        if eqn.primitive.name == "cholesky" or any(map(count_factorised, inner)):
            assert needs or not found, eqn
            needs = True
        for program in inner:
            assert_in_turn(program)
        if needs:
            found.update(eqn.outvars)
