"""How a CPU computes the physics of each task: with the batch last, but for what is listed here."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

import pixelbrax_jax as pb
from pixelbrax_jax._platform import interpreter
from pixelbrax_jax._platform.interpreter import batch_last
from pixelbrax_jax.tasks import BRAX_TASKS
from tests.platform.equations import equations

NUM_ENVS = 48
"""No other length in any task, and a multiple of the lanes."""

FAST = ("ant", "swimmer")
CASES = [
    pytest.param(
        name,
        backend,
        marks=() if name in FAST and backend == task.default_backend else pytest.mark.slow,
    )
    for name, task in BRAX_TASKS.items()
    for backend in task.backends
]


def trace(task: str, backend: str) -> jax.extend.core.ClosedJaxpr:
    """Trace a step of the physics as `VectorPixelEnv` does on a CPU."""
    env, params = pb.make(task, backend=backend, obs_mode="state")
    envs = pb.VectorPixelEnv(env, NUM_ENVS)
    state, _ = jax.eval_shape(envs.reset, jax.random.key(0), params)
    action = jax.ShapeDtypeStruct((NUM_ENVS, env.action_size), jnp.float32)
    advance = batch_last(env.advance, (0, 0, 0, None))
    return jax.make_jaxpr(advance)(state.sim, state.key, action, params)


def without_rule(task: str, backend: str) -> set[str]:
    """What is left to ``jax.vmap``. It must not grow: add a rule to `rules`, or slow down."""
    if backend == "mjx":
        loops = {"while", "dynamic_slice"}
        return {"cholesky", "dot_general", "random_fold_in", "triangular_solve"} | loops
    few_joints = ("inverted_double_pendulum", "inverted_pendulum", "reacher", "swimmer")
    products = {"dot_general"} if backend == "generalized" and task not in few_joints else set()
    return {"custom_jvp_call", "random_fold_in"} | products


@pytest.mark.parametrize(("task", "backend"), CASES)
def test_primitives_without_a_rule_are_those_listed(task, backend, monkeypatch):
    found = set()
    by_vmap = interpreter._by_vmap

    def record(eqn, inputs):
        found.add(eqn.primitive.name)
        return by_vmap(eqn, inputs)

    monkeypatch.setattr(interpreter, "_by_vmap", record)
    closed = trace(task, backend)
    assert found <= without_rule(task, backend)
    # What has rules keeps the batch last: only the ends of the program may move it.
    batched = [
        (eqn.primitive.name, var.aval.shape)
        for eqn in equations(closed.jaxpr)
        for var in eqn.outvars
        if NUM_ENVS in var.aval.shape
    ]
    first = [name for name, shape in batched if NUM_ENVS in shape[:-1] and name not in found]
    # What is in a loop that ends by itself has the batch first, as `jax.vmap` puts it.
    assert "while" in found or len(first) < len(batched) / 20
