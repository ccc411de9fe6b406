"""How a CPU computes the physics of each task: with the batch last, but for what is listed here."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

import pixelbrax_jax as pb
from pixelbrax_jax._cpu import interpreter
from pixelbrax_jax._cpu.interpreter import batch_last
from pixelbrax_jax.tasks import TASKS
from tests.cpu.equations import equations

NUM_ENVS = 48
"""No other length in any task, and a multiple of the lanes."""

CASES = [
    pytest.param(name, backend, marks=() if backend == task.backends[0] else pytest.mark.slow)
    for name, task in TASKS.items()
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


@pytest.mark.parametrize(("task", "backend"), CASES)
def test_primitives_without_a_rule_are_those_listed(task, backend, monkeypatch):
    found = set()
    by_vmap = interpreter._by_vmap

    def record(eqn, inputs):
        found.add(eqn.primitive.name)
        return by_vmap(eqn, inputs)

    monkeypatch.setattr(interpreter, "_by_vmap", record)
    closed = trace(task, backend)
    assert found <= WITHOUT_RULE.get((task, backend), WITHOUT_RULE[backend])
    # What has rules keeps the batch last: only the ends of the program may move it.
    batched = [
        (eqn.primitive.name, var.aval.shape)
        for eqn in equations(closed.jaxpr)
        for var in eqn.outvars
        if NUM_ENVS in var.aval.shape
    ]
    first = [name for name, shape in batched if NUM_ENVS in shape[:-1] and name not in found]
    assert len(first) < len(batched) / 20


WITHOUT_RULE = {}
