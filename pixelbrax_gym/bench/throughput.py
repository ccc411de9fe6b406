"""Measure frames per second of the renderer and steps per second of environments."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import pixelbrax_jax as pb

REPETITIONS = 5
REPETITION_SECONDS = 0.5
"""Minimum duration of a repetition."""


def compiled(
    env: Any, function: Callable, *arguments: Any, **jit_options: Any
) -> tuple[Any, float]:
    """Return the compiled function and the seconds to trace and compile it."""
    started = time.perf_counter()
    jitted = jax.jit(function, compiler_options=pb.compiler_options(env), **jit_options)
    program = jitted.lower(*arguments).compile()
    return program, time.perf_counter() - started


def rate(run: Callable[[int], Any], least_calls: int = 1) -> dict[str, float]:
    """Measure calls per second; ``run(n)`` makes n calls and returns arrays to wait for."""
    calls = least_calls
    seconds_of(run, calls)
    while (seconds := seconds_of(run, calls)) < REPETITION_SECONDS:
        wanted = 1.1 * REPETITION_SECONDS / max(seconds, 1e-6)
        calls = max(calls + 1, int(calls * min(10.0, wanted)))
    rates = [calls / seconds_of(run, calls) for _ in range(REPETITIONS)]
    return {
        "median": float(np.median(rates)),
        "slowest": min(rates),
        "fastest": max(rates),
        "calls": calls,
    }


def seconds_of(run: Callable[..., Any], *arguments: Any) -> float:
    """Return the seconds of a call, until its arrays are complete."""
    started = time.perf_counter()
    jax.block_until_ready(run(*arguments))
    return time.perf_counter() - started


def renderer(
    task: str,
    num_envs: int,
    size: int = 84,
    look: str = "default",
    shadows: bool = False,
    renderer: str = "auto",
) -> dict[str, Any]:
    """Measure rendering from link poses to packed pixels, without physics."""
    env, params = pb.make(
        task, look=look, shadows=shadows, height=size, width=size, renderer=renderer
    )
    _, run, compile_seconds = drawing(env, params, num_envs)
    speed = rate(run)
    return {
        "frames_per_second": num_envs * speed["median"],
        "speed": speed,
        "compile_seconds": compile_seconds,
    }


def drawing(
    env: pb.PixelEnv, params: Any, num_envs: int
) -> tuple[Any, Callable[[int], Any], float]:
    """Return the program that draws first states, its calls for ``rate``, and compile seconds."""
    states = first_states(env, params, num_envs)
    program, compile_seconds = compiled(env, jax.vmap(env.draw, in_axes=(0, None)), states, params)

    def run(calls: int) -> Any:
        for _ in range(calls):
            words = program(states, params)
        return words

    return program, run, compile_seconds


def first_states(env: pb.PixelEnv, params: Any, num_envs: int) -> Any:
    """Return batched simulator states at the start of episodes."""
    keys = jax.random.split(jax.random.key(0), num_envs)
    reset = jax.jit(jax.vmap(lambda key: env.reset_sim(key, jnp.uint32(0), params)))
    return reset(keys)


def scan(task: str, num_envs: int, obs_mode: str = "pixels") -> dict[str, Any]:
    """Measure environment steps in one compiled loop, with random actions and autoreset.

    Every frame enters the frame stack in the loop's state, so no rendering is optimised away.
    """
    env, params = pb.make(task, obs_mode=obs_mode)
    venv = pb.VectorPixelEnv(env, num_envs)
    state, timestep = venv.reset(jax.random.key(0), params)

    def steps(state: Any, key: jax.Array, params: Any, count: jax.Array) -> Any:
        def step(_: jax.Array, carry: Any) -> Any:
            state, key, total = carry
            key, draw = jax.random.split(key)
            shape = (num_envs, env.action_size)
            action = jax.random.uniform(draw, shape, minval=-1.0, maxval=1.0)
            state, timestep = venv.step(state, action, params)
            return state, key, total + timestep.reward.sum()

        return jax.lax.fori_loop(0, count, step, (state, key, jnp.float32(0.0)))

    key = jax.random.key(1)
    program, compile_seconds = compiled(
        env, steps, state, key, params, jnp.int32(1), donate_argnums=0
    )
    held = sum(leaf.nbytes for leaf in jax.tree.leaves((state, timestep)) if leaf.ndim)
    carry = {"state": state, "key": key}
    del state, timestep

    def run(calls: int) -> Any:
        carry["state"], carry["key"], total = program(
            carry["state"], carry["key"], params, jnp.int32(calls)
        )
        return total

    # Allocating a call's memory takes 10 % of the time of four steps of 1000 environments.
    speed = rate(run, least_calls=16)
    return {
        "steps_per_second": num_envs * speed["median"],
        "speed": speed,
        "compile_seconds": compile_seconds,
        "bytes_per_env": held / num_envs,
    }
