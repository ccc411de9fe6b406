"""Steps and frames per second, compiled first and timed when asked."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp

import pixelbrax_jax as pb
from pixelbrax_gym.bench.throughput import compiled, drawing, rate
from pixelbrax_jax.tasks import DMC_TASKS

Policy = Callable[[Any, jax.Array], jax.Array]
"""Maps a batch of observations and a key to actions."""


def steps(
    task: str,
    num_envs: int,
    size: int | None,
    policy: str,
    flags: str = "",
    engine: str = "auto",
) -> Callable[[float], dict[str, Any]]:
    """Measure environment steps in one compiled loop, with autoreset.

    Args:
        task: the task; those of DM Control draw their initial states from 4096 made once.
        num_envs: N.
        size: height and width of images in pixels; None has states as observations.
        policy: ``"random"``, uniform actions; or ``"network"``, which sees every observation.
        flags: XLA's flags of the process, which are set before it starts.
        engine: the physics engine of a task of DM Control.
    """
    del flags
    options: dict[str, Any] = {"height": size, "width": size} if size else {"obs_mode": "state"}
    if task in DMC_TASKS:
        options |= {"num_starts": 4096, "engine": engine}
    env, params = pb.make(task, **options)
    params = jax.device_put(params)
    venv = pb.VectorPixelEnv(env, num_envs)
    key = jax.random.key(0)
    state, timestep = jax.eval_shape(venv.reset, key, params)
    act = _network(env, timestep.obs) if policy == "network" else None

    def random(key: jax.Array) -> jax.Array:
        return jax.random.uniform(key, (num_envs, env.action_size), minval=-1.0, maxval=1.0)

    def loop(state: Any, obs: Any, key: jax.Array, params: Any, count: jax.Array) -> Any:
        def step(_: jax.Array, carry: Any) -> Any:
            state, obs, key, total = carry
            key, draw = jax.random.split(key)
            action = random(draw) if act is None else act(obs, draw)
            state, timestep = venv.step(state, action, params)
            # A random policy reads no observation; frames are in the state.
            obs = None if act is None else timestep.obs
            return state, obs, key, total + timestep.reward.sum()

        return jax.lax.fori_loop(0, count, step, (state, obs, key, jnp.float32(0.0)))

    seen = None if act is None else timestep.obs
    reset, _ = compiled(env, venv.reset, key, params)
    program, _ = compiled(env, loop, state, seen, key, params, jnp.int32(1), donate_argnums=(0, 1))
    # Before this nothing is allocated, so that many may wait.
    carry: dict[str, Any] = {}

    def run(calls: int) -> Any:
        carry["now"], total = _split(program(*carry["now"], params, jnp.int32(calls)))
        return total

    def timed(_: float) -> dict[str, Any]:
        state, timestep = reset(key, params)
        # A donated buffer may not be another argument, too.
        obs = None if act is None else jax.tree.map(jnp.copy, timestep.obs)
        del timestep
        carry["now"] = (state, obs, key)
        del state, obs
        speed = rate(run, least_calls=16)
        return {
            "steps_per_second": num_envs * speed["median"],
            "speed": speed,
            "temporary_bytes": _temporaries(program),
        }

    return timed


def _split(found: tuple[Any, Any, Any, jax.Array]) -> tuple[tuple[Any, Any, Any], jax.Array]:
    *now, total = found
    return tuple(now), total  # type: ignore[return-value]


def _temporaries(program: Any) -> int | None:
    memory = program.memory_analysis()
    return getattr(memory, "temp_size_in_bytes", None)


def _network(env: Any, obs: Any) -> Policy:
    """Return a Gaussian policy with fresh weights: of images DQN's encoder, of states 2 x 256."""
    key = jax.random.key(1)
    if obs.dtype == jnp.uint8:
        from pixelbrax_jax.agents.networks.actor_critic import Actor

        actor = Actor("nature", env.action_size, "gaussian")
        weights = actor.init(key, jnp.zeros((1, *obs.shape[1:]), obs.dtype))

        def of_pixels(obs: Any, key: jax.Array) -> jax.Array:
            policy = actor.apply(weights, obs).policy
            return policy.action(policy.sample(key))

        return of_pixels
    sizes = (obs.shape[-1], 256, 256, env.action_size)
    layers = [
        jax.random.normal(jax.random.fold_in(key, i), shape) / shape[0] ** 0.5
        for i, shape in enumerate(pairwise(sizes))
    ]

    def of_states(obs: Any, key: jax.Array) -> jax.Array:
        for layer in layers[:-1]:
            obs = jnp.tanh(obs @ layer)
        mean = obs @ layers[-1]
        return mean + jax.random.normal(key, mean.shape)

    return of_states


def frames(task: str, num_envs: int, size: int, renderer: str) -> Callable[[float], dict[str, Any]]:
    """Measure rendering from link poses to packed pixels, without physics and shadows."""
    if renderer == "pallas" and jax.default_backend() != "gpu":
        renderer = "auto"
    env, params = pb.make(task, height=size, width=size, renderer=renderer)
    program, run, _ = drawing(env, jax.device_put(params), num_envs)

    def timed(_: float) -> dict[str, Any]:
        speed = rate(run)
        return {
            "frames_per_second": num_envs * speed["median"],
            "speed": speed,
            "temporary_bytes": _temporaries(program),
        }

    return timed
