"""The programs that are compiled, and the shapes of their arguments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import pixelbrax_jax as pb
from pixelbrax_gym.bench.ahead.case import PROGRAMS
from pixelbrax_jax.validation import check_choice

SCAN_LENGTH = 16


def make_program(
    name: str, task: str, num_envs: int, **options: Any
) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Make a program with the shapes of its arguments; nothing is computed.

    Args:
        name: one of ``PROGRAMS``: frames of states, drawn as the device has it and by the plain
            ray-caster; a step of a pixel environment; one without pixels; a loop over
            ``SCAN_LENGTH`` steps with pixels.
        task: the task.
        num_envs: environments.
        **options: further ones of ``pixelbrax_jax.make``.

    Returns:
        The function and its arguments, as trees of ``jax.ShapeDtypeStruct``.

    Raises:
        ValueError: there is no such program.
    """
    check_choice("program", name, PROGRAMS)
    obs_mode = "state" if name == "state step" else "pixels"
    if name == "plain renderer":
        options = {"renderer": "fused", **options}
    # The batch as for any device: "auto" is for the one that JAX computes on.
    env, params = pb.make(task, obs_mode=obs_mode, **options)
    envs = pb.VectorPixelEnv(env, num_envs)
    state, _ = jax.eval_shape(envs.reset, jax.eval_shape(lambda: jax.random.key(0)), params)
    params = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.asarray(x).dtype), params
    )
    action = jax.ShapeDtypeStruct((num_envs, env.action_size), jnp.float32)
    if name.endswith("renderer"):
        return jax.vmap(env.draw, in_axes=(0, None)), (state.sim, params)
    if name != "scan":
        return envs.step, (state, action, params)

    def scan(state: Any, x: jax.Array, p: Any) -> Any:
        def step(state: Any, _: None) -> tuple[Any, jax.Array]:
            state, timestep = envs.step(state, x, p)
            return state, timestep.reward

        return jax.lax.scan(step, state, None, length=SCAN_LENGTH)

    return scan, (state, action, params)
