"""Protection from diverging physics, and equality of physics."""

from __future__ import annotations

import abc
from collections.abc import Callable, Hashable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pixelbrax_jax.flags import under_environment_flags
from pixelbrax_jax.physics.base import Physics
from pixelbrax_jax.spatial import quat_normalize
from pixelbrax_jax.types import PhysicsState

# MuJoCo's limit for bad numbers (``mju_isBad``). It is small enough for float32 to render a scene.
LARGEST = 1e10


class Recipe(NamedTuple):
    """A module's function and its hashable arguments that make the physics."""

    make: Callable[..., Any]
    arguments: tuple[Any, ...]


class GuardedPhysics(Physics):
    """Base of a ``Physics`` that ends an episode cleanly when its simulation diverges.

    A step has diverged if a watched number is not finite or exceeds 1e10 in magnitude. It returns
    the state before it, with reward 0 and ``terminated`` and ``non_finite`` true.
    """

    _identity: Hashable = None
    """Objects of one class and identity are equal; with None an object equals only itself. If it is
    a ``Recipe``, a pickle contains nothing else."""

    @abc.abstractmethod
    def _reset(self, key: jax.Array) -> PhysicsState:
        """Sample an initial state, finite or not; see ``Physics.reset``."""

    @abc.abstractmethod
    def _step(self, state: PhysicsState, action: jax.Array) -> PhysicsState:
        """Advance by one control step, finite or not; see ``Physics.step``."""

    @abc.abstractmethod
    def _watched(self, state: PhysicsState) -> Any:
        """Return a tree of values that must be finite, besides observation and reward."""

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, GuardedPhysics) or self._identity is None:
            return self is other
        return type(self) is type(other) and self._identity == other._identity

    def __hash__(self) -> int:
        return object.__hash__(self) if self._identity is None else hash(self._identity)

    def __reduce_ex__(self, protocol: Any) -> Any:
        if isinstance(self._identity, Recipe):
            return self._identity.make, self._identity.arguments
        return super().__reduce_ex__(protocol)

    def __deepcopy__(self, memo: dict[int, Any]) -> GuardedPhysics:
        return self

    # Traced once for equal objects in all programs.

    @partial(jax.jit, static_argnums=0, inline=True)
    @under_environment_flags
    def reset(self, key: jax.Array, *dynamics: jax.Array) -> PhysicsState:
        """See ``Physics.reset``."""
        return self._guard_first(self._reset(key, *dynamics))

    @partial(jax.jit, static_argnums=0, inline=True)
    @under_environment_flags
    def step(self, state: PhysicsState, action: jax.Array) -> PhysicsState:
        """See ``Physics.step``."""
        if jnp.shape(action) != (self.action_size,):
            raise ValueError(
                f"action must have shape ({self.action_size},), got {jnp.shape(action)}."
            )
        after = self._step(state, action)
        finite = self._is_finite(after)
        kept: PhysicsState = _select(finite, after, state)
        return kept.replace(
            reward=jnp.where(finite, after.reward, 0.0),
            terminated=~finite | after.terminated,
            non_finite=~finite,
        )

    def _guard_first(self, state: PhysicsState) -> PhysicsState:
        finite = self._is_finite(state)
        return state.replace(
            xpos=_select(finite, state.xpos, jnp.zeros_like(state.xpos)),
            xquat=_select(finite, state.xquat, quat_normalize(jnp.zeros_like(state.xquat))),
            obs=_select(finite, state.obs, jnp.zeros_like(state.obs)),
            reward=jnp.zeros((), jnp.float32),
            terminated=~finite,
            non_finite=~finite,
        )

    def _is_finite(self, state: PhysicsState) -> jax.Array:
        watched = (self._watched(state), state.obs, state.reward)
        # False for NaN too.
        leaves = [jnp.all(jnp.abs(leaf) < LARGEST) for leaf in jax.tree.leaves(watched)]
        return jnp.all(jnp.stack(leaves))


def _select(choose_first: jax.Array, first: Any, second: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(choose_first, a, b), first, second)
