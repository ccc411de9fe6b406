"""Functions that Brax needs and current releases of JAX lack. Importing it does not load Brax."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec


class _NumpyWithOldClip:
    """``jax.numpy`` with a ``clip`` that accepts ``a_min`` and ``a_max``."""

    @staticmethod
    def clip(
        a: jax.Array,
        a_min: jax.typing.ArrayLike | None = None,
        a_max: jax.typing.ArrayLike | None = None,
    ) -> jax.Array:
        return jnp.clip(a, a_min, a_max)

    def __getattr__(self, name: str) -> Any:
        return getattr(jnp, name)


def accept_old_clip(module: ModuleType) -> None:
    """Let a module call ``jp.clip(x, a_min=...)``, as Brax's fluid forces (the swimmer) do.

    The name ``jp`` is replaced only in that module, and only if JAX lacks the argument.
    """
    if "a_min" not in inspect.signature(jnp.clip).parameters and vars(module)["jp"] is jnp:
        vars(module)["jp"] = _NumpyWithOldClip()


class _JaxWithReplicated:
    """``jax`` with ``device_put_replicated``."""

    @staticmethod
    def device_put_replicated(x: Any, devices: Sequence[jax.Device]) -> Any:
        """Return ``x`` with a new leading axis, one row on each device."""
        sharding = NamedSharding(Mesh(np.array(devices), ("row",)), PartitionSpec("row"))

        def put(leaf: jax.typing.ArrayLike) -> jax.Array:
            rows = jnp.broadcast_to(leaf, (len(devices), *jnp.shape(leaf)))
            return jax.device_put(rows, sharding)

        return jax.tree.map(put, x)

    def __getattr__(self, name: str) -> Any:
        return getattr(jax, name)


def accept_device_put_replicated(module: ModuleType) -> None:
    """Let a module call ``jax.device_put_replicated``, as Brax's trainers do.

    The name ``jax`` is replaced only in that module, and only if JAX lacks the function.
    """
    if not hasattr(jax, "device_put_replicated") and vars(module)["jax"] is jax:
        vars(module)["jax"] = _JaxWithReplicated()
