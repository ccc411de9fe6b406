"""Costs of contacts with elliptic friction cones.

The formulas are from MuJoCo's documentation, "Computation", section "Constraint model". N and T are
the normal and tangential parts of a scaled residual. Contacts with N >= mu T are free. Those with
mu N + T <= 0 stick, with a quadratic cost. The others slip, with the cost of the distance to the
cone, D_0 (N - mu T)^2 / (2 mu^2 (1 + mu^2)).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mujoco.opengl import mujoco

_NEGLECTED = 1e-5
"""Accepted error of Newton's last step, as a fraction of a contact's force."""


class Cones(NamedTuple):
    """C contacts of k constraints each: the normal, then tangential ones; (C, k) float32 each.

    ``stiffness`` is D, and ``scale`` is mu, then friction, which make the elliptic cone round.
    """

    stiffness: jax.Array
    scale: jax.Array

    def _parts(self, residual: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return N (C,), T (C,), and the unit tangents (C, k - 1)."""
        scaled = residual * self.scale
        square = jnp.sum(scaled[:, 1:] ** 2, axis=1)
        length = jnp.sqrt(square)
        tangent = scaled[:, 1:] / jnp.where(square > 0, length, 1.0)[:, None]
        return scaled[:, 0], length, tangent

    @property
    def _mu(self) -> jax.Array:
        return self.scale[:, 0]

    @property
    def _slip_stiffness(self) -> jax.Array:
        square = self._mu**2
        return self.stiffness[:, 0] / jnp.maximum(square * (1 + square), mujoco.mjMINVAL)

    def _by_zone(self, residual: jax.Array, sticking: jax.Array, slipping: jax.Array) -> jax.Array:
        """Return 0 for free contacts, else ``sticking`` or ``slipping``, (C, ...)."""
        normal, length, _ = self._parts(residual)
        axes = range(1, sticking.ndim)
        is_free = jnp.expand_dims(normal >= self._mu * length, axes)
        sticks = jnp.expand_dims(self._mu * normal + length <= 0, axes)
        return jnp.where(is_free, 0.0, jnp.where(sticks, sticking, slipping))

    def cost(self, residual: jax.Array) -> jax.Array:
        """Return the sum of all costs for residuals (C, k)."""
        normal, length, _ = self._parts(residual)
        sticking = 0.5 * jnp.sum(self.stiffness * residual**2, axis=1)
        slipping = 0.5 * self._slip_stiffness * (normal - self._mu * length) ** 2
        return jnp.sum(self._by_zone(residual, sticking, slipping))

    def slope(self, residual: jax.Array) -> jax.Array:
        """Return derivatives (C, k) of the cost by residuals (C, k)."""
        normal, length, tangent = self._parts(residual)
        slipping = self._slip_stiffness * (normal - self._mu * length)
        slipping = slipping[:, None] * self._outward(tangent)
        return self._by_zone(residual, self.stiffness * residual, slipping)

    def curvature_times(self, residual: jax.Array, rows: jax.Array) -> jax.Array:
        """Return second derivatives at residuals (C, k) times rows (C, k, V)."""
        normal, length, tangent = self._parts(residual)
        outward = self._outward(tangent)[..., None]
        gap = normal - self._mu * length
        # The cone is curved across the tangent: 1 / T (1 - t t').
        turning = -self._mu * gap / jnp.where(length > 0, length, 1.0)
        across = self.scale[:, 1:, None] * rows[:, 1:]
        along = jnp.sum(tangent[..., None] * across, axis=1, keepdims=True)
        across = self.scale[:, 1:, None] * (across - tangent[..., None] * along)
        curved = jnp.pad(turning[:, None, None] * across, [(0, 0), (1, 0), (0, 0)])
        straight = outward * jnp.sum(outward * rows, axis=1, keepdims=True)
        slipping = self._slip_stiffness[:, None, None] * (straight + curved)
        return self._by_zone(residual, self.stiffness[..., None] * rows, slipping)

    def stay(self, residual: jax.Array, change: jax.Array) -> jax.Array:
        """Return () bool, whether a change of residuals (C, k) changes slopes as predicted."""
        before, after = self.slope(residual), self.slope(residual + change)
        expected = before + self.curvature_times(residual, change[..., None])[..., 0]
        largest = jnp.max(jnp.abs(after), axis=1)
        return jnp.all(jnp.max(jnp.abs(after - expected), axis=1) <= _NEGLECTED * largest)

    def _outward(self, tangent: jax.Array) -> jax.Array:
        """Return (C, k), the derivative of N - mu T by the residual."""
        return self.scale * jnp.concatenate(
            [jnp.ones_like(self._mu)[:, None], -self._mu[:, None] * tangent], axis=1
        )
