"""MuJoCo Warp: steps of a model on an NVIDIA GPU, and slowly on a CPU."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.extras import needs_extra
from pixelbrax_jax.physics.mujoco.needs import Needs
from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.physics.mujoco.xla import Arrays, Mjx, changed

with needs_extra("warp"):
    import warp

# It prints a line for each of some sixty kernels that it compiles.
warp.config.log_level = max(warp.config.log_level, warp.LOG_WARNING)

from mujoco import mjx  # noqa: E402  # isort: skip


_TAKEN = ("qpos", "qvel", "act", "qacc_warmstart", "ctrl")
"""Fields of ``MjData`` that a step takes."""


class Warp(Mjx):
    """The same as ``Xla``, with steps by MuJoCo Warp; all else is computed by MuJoCo XLA."""

    def __init__(self, model: mujoco.MjModel, needs: Needs):
        super().__init__(model, needs)
        if "cfrc_ext" in self._fields:
            raise ValueError(
                "engine='warp' does not compute cfrc_ext, which this task's formulas need. Choose "
                "engine='xla' or engine='auto'."
            )
        self._warp = mjx.put_model(self.simulated, impl="warp")
        # Contacts and constraints of MuJoCo XLA are as many as there can be.
        most = mjx.make_data(self.simulated, impl="jax")._impl
        self._most_contacts = max(1, most.contact.dist.shape[0])
        self._most_constraints = max(1, most.efc_D.shape[0])
        self._rows = self._make_rows()

    def _mover(self, model: Any, multipliers: jax.Array) -> Callable[[Any], Any]:
        """See ``Xla``; Warp has its own model."""
        del model

        def move(data: Any) -> Any:
            rows = self._rows(multipliers[None], *(getattr(data, name)[None] for name in _TAKEN))
            return data.replace(**{name: x[0] for name, x in zip(self._left, rows, strict=True)})

        return move

    def _make_rows(self) -> Any:
        """Return a function that steps (N, ...) rows: Warp must know how many there are."""

        @jax.custom_batching.custom_vmap
        def rows(*arrays: jax.Array) -> Arrays:
            blank = self._blank(len(arrays[0]))

            def one(multipliers: jax.Array, *row: jax.Array) -> Arrays:
                data = blank.replace(**dict(zip(_TAKEN, row, strict=True)))
                data = mjx.step(changed(self._warp, multipliers), data)
                return tuple(getattr(data, name) for name in self._left)

            result: Arrays = jax.vmap(one)(*arrays)
            return result

        @rows.def_vmap
        def rows_of_rows(
            size: int, batched: list[bool], *arrays: jax.Array
        ) -> tuple[Arrays, tuple[bool, ...]]:
            many = [
                x if is_batched else jnp.broadcast_to(x, (size, *x.shape))
                for x, is_batched in zip(arrays, batched, strict=True)
            ]
            each = many[0].shape[1]
            results = rows(*(x.reshape(size * each, *x.shape[2:]) for x in many))
            shaped = tuple(x.reshape(size, each, *x.shape[1:]) for x in results)
            return shaped, (True,) * len(shaped)

        return rows

    def _blank(self, num_rows: int) -> Any:
        with jax.ensure_compile_time_eval():
            data = mjx.make_data(
                self.simulated,
                impl="warp",
                naconmax=num_rows * self._most_contacts,
                njmax=self._most_constraints,
            )
        return jax.tree.map(_filled, data)


def _filled(x: jax.Array) -> jax.Array:
    """Return equal numbers as one broadcast number, so that a program does not contain all."""
    values = np.asarray(x)
    if values.size and (values == values.flat[0]).all():
        return jnp.full(values.shape, values.flat[0], values.dtype)
    return x
