"""A check of the rules for pixel environments."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.types import EnvParams, EnvState, Timestep

_NUM_STEPS = 3


class ContractError(AssertionError):
    """An environment violates a rule that agents and adapters rely on."""


def check_env(env: PixelEnv, params: EnvParams, *, seed: int = 0) -> None:
    """Run an environment for a few steps and check the rules for environments.

    It checks shapes and dtypes of observation, reward and flags; that state and timestep keep their
    structure; one compilation for any state; equal results under jit, ``vmap`` and ``lax.scan``;
    equal bits for equal keys and different ones for different keys; frame stacks that start with
    copies of the first frame; separate termination and truncation; and that a NaN action ends the
    episode with finite numbers.

    Raises:
        ContractError: a rule is violated; the message has the rule.
    """
    key = jax.random.key(seed)
    actions = jax.random.uniform(
        jax.random.fold_in(key, 1), (_NUM_STEPS, env.action_size), minval=-1.0, maxval=1.0
    )
    state, first = env.reset(key, params)
    _check_timestep(env, first, "reset")
    _require(float(first.reward) == 0.0, "the reward after a reset must be 0")
    _require(not bool(first.truncated), "an episode must not start truncated")
    _check_stack(env, first)

    loop_states, loop_steps = [state], []
    for action in actions:
        state, timestep = env.step(loop_states[-1], action, params)
        _check_timestep(env, timestep, "step")
        _same_structure(loop_states[0], state, "state after a step")
        _same_structure(first, timestep, "timestep after a step")
        loop_states.append(state)
        loop_steps.append(timestep)
    _check_determinism(env, params, key, first)
    _check_transforms(env, params, loop_states[0], actions, loop_steps)
    _check_single_trace(env, params, loop_states[0], state, actions[0])

    _, broken = env.step(state, jnp.full(env.action_size, jnp.nan), params)
    _require(bool(broken.terminated), "a NaN action must terminate the episode")
    _require(bool(broken.info["non_finite"]), "a NaN action must set info['non_finite']")
    _check_timestep(env, broken, "a step with a NaN action")


def _require(condition: bool, rule: str) -> None:
    if not condition:
        raise ContractError(rule + ".")


def _describe(tree: Any) -> list[tuple[str, tuple[int, ...], str]]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return [(jax.tree_util.keystr(path), x.shape, str(x.dtype)) for path, x in leaves]


def _same_structure(expected: Any, actual: Any, what: str) -> None:
    rule = f"{what} must keep its structure"
    for before, after in zip(_describe(expected), _describe(actual), strict=False):
        _require(before == after, f"{rule}: {before} became {after}")
    wanted: Any = jax.tree.structure(expected)
    _require(wanted == jax.tree.structure(actual), rule)


def _check_timestep(env: PixelEnv, timestep: Timestep, origin: str) -> None:
    expected, actual = _describe(env.obs_spec), _describe(timestep.obs)
    _require(expected == actual, f"the observation of {origin} must be {expected}, is {actual}")
    for name, dtype in (("reward", "float32"), ("terminated", "bool"), ("truncated", "bool")):
        value = getattr(timestep, name)
        _require(
            value.shape == () and value.dtype == dtype,
            f"{name} of {origin} must be a {dtype} scalar, is {value.dtype}{value.shape}",
        )
    _require(
        not bool(timestep.terminated & timestep.truncated),
        f"{origin} must not be terminated and truncated at once",
    )
    for path, leaf in jax.tree_util.tree_leaves_with_path((timestep.obs, timestep.reward)):
        finite = bool(jnp.isfinite(leaf).all())
        _require(finite, f"{origin} must be finite, {jax.tree_util.keystr(path)} is not")


def _check_stack(env: PixelEnv, first: Timestep) -> None:
    for part in jax.tree.leaves(first.obs):
        if part.ndim == 3:
            frames = np.asarray(part).reshape(*part.shape[:2], env.frame_stack, -1)
            alike = bool((frames == frames[:, :, :1]).all())
            _require(alike, "the first observation must be copies of the first frame")


def _check_determinism(env: PixelEnv, params: EnvParams, key: jax.Array, first: Timestep) -> None:
    again_state, again = env.reset(key, params)
    _require(_equal(first, again), "equal keys must give equal bits")
    other_state, _ = env.reset(jax.random.fold_in(key, 2), params)
    next_state, _ = env.next_episode(again_state, params)
    for other, rule in ((other_state, "different keys"), (next_state, "successive episodes")):
        same = _equal(again_state.sim.physics, other.sim.physics)
        _require(not same, f"{rule} must start differently")


def _check_transforms(
    env: PixelEnv,
    params: EnvParams,
    start: EnvState,
    actions: jax.Array,
    loop_steps: list[Timestep],
) -> None:
    _, scanned = jax.lax.scan(lambda state, a: env.step(state, a, params), start, actions)
    twice = jax.tree.map(lambda x: jnp.stack([x, x]), start)
    _, mapped = jax.vmap(env.step, in_axes=(0, 0, None))(twice, jnp.stack([actions[0]] * 2), params)
    for t, expected in enumerate(loop_steps):
        row = jax.tree.map(lambda x, t=t: x[t], scanned)
        _require(_close(expected, row), f"lax.scan must give what a loop gives (step {t})")
    for i in range(2):
        row = jax.tree.map(lambda x, i=i: x[i], mapped)
        _require(_close(loop_steps[0], row), "jax.vmap must give what single steps give")


def _check_single_trace(
    env: PixelEnv, params: EnvParams, first: EnvState, later: EnvState, action: jax.Array
) -> None:
    traces: list[None] = []

    @jax.jit
    def step(state: EnvState, action: jax.Array, params: EnvParams) -> jax.Array:
        traces.append(None)
        return env.step(state, action, params)[0].sim.step_count

    for state in (first, later):
        step(state, action, params)
    _require(len(traces) == 1, "a later state must not compile the step again")


def _equal(a: Any, b: Any) -> bool:
    return all(map(jnp.array_equal, jax.tree.leaves(a), jax.tree.leaves(b)))


def _close(a: Any, b: Any) -> bool:
    """Return whether two results are equal up to the order of float operations in a few steps."""
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        x, y = np.asarray(x), np.asarray(y)
        if x.ndim == 3:
            # Rounding may change a pixel on a silhouette, but not an image.
            most = 1 if x.dtype == np.uint8 else 1e-2 * np.abs(x).max()
            if (np.abs(x.astype(float) - y.astype(float)) > most).mean() > 0.01:
                return False
        elif not np.allclose(x, y, rtol=1e-2, atol=1e-2):
            return False
    return True
