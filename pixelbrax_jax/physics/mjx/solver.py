"""Constraint forces by Newton's method, in fewer and cheaper iterations than MuJoCo XLA's."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from pixelbrax_jax.physics.mjx import elimination
from pixelbrax_jax.physics.mujoco_compatibility import import_silenced

with import_silenced():
    from mujoco.mjx._src import support

ITERATIONS = 16
"""Newton's steps at most; those that change no active constraint are the last."""

LINE_SEARCH_ITERATIONS = 6
"""Steps along a direction at most, of those that change active constraints."""

_ROWS = 16
"""Rows of a product of matrices that are added up at a time, if it has no more columns."""

_EQUALITY, _FRICTION, _ONE_SIDED = range(3)

_Carry = tuple[jax.Array, jax.Array, jax.Array, jax.Array]


def is_supported(model: mujoco.MjModel) -> bool:
    """Return whether the model asks for what this solver does: pyramids and Newton's method."""
    return bool(
        model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
        and model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    )


class _Problem(NamedTuple):
    """Minimise ``(a - smooth) M (a - smooth) / 2 + sum(cost(J a - reference))`` over ``a``.

    The derivative of a constraint's cost is ``clip(stiffness * x, low, high)``: of an equality
    without bounds, of dry friction with those of its force, of limits and contacts at most 0.
    """

    inertia: jax.Array
    smooth: jax.Array
    jacobian: jax.Array
    reference: jax.Array
    stiffness: jax.Array
    low: jax.Array
    high: jax.Array

    def residual(self, acceleration: jax.Array) -> jax.Array:
        return self.jacobian @ acceleration - self.reference

    def slope(self, residual: jax.Array) -> jax.Array:
        return jnp.clip(self.stiffness * residual, self.low, self.high)

    def piece(self, residual: jax.Array) -> jax.Array:
        """Return where costs are: 0 where they are quadratic, -1 and 1 at bounds of the slope."""
        slope = self.stiffness * residual
        return (slope >= self.high).astype(jnp.int32) - (slope <= self.low).astype(jnp.int32)

    def curvature(self, piece: jax.Array) -> jax.Array:
        return jnp.where(piece == 0, self.stiffness, 0.0)

    def cost(self, acceleration: jax.Array) -> jax.Array:
        residual = self.residual(acceleration)
        slope = self.slope(residual)
        away = acceleration - self.smooth
        least = slope * slope / jnp.maximum(2 * self.stiffness, mujoco.mjMINVAL)
        return 0.5 * away @ (self.inertia @ away) + jnp.sum(slope * residual - least)


def solve(model: Any, data: Any) -> Any:
    """Find accelerations and constraint forces, as ``mujoco.mjx._src.solver.solve`` does.

    Every cost is quadratic between kinks, so that Newton's step is exact once the right
    constraints are active: the loop ends where a whole step leaves them as they are.

    Args:
        model: ``mujoco.mjx.Model`` with pyramidal cones.
        data: ``mujoco.mjx.Data`` with constraints and accelerations without them.

    Returns:
        ``data`` with ``qacc``, ``qfrc_constraint`` and ``efc_force``.
    """
    impl = data._impl
    # MuJoCo's order: equalities, dry friction, then limits and contacts.
    counts = [impl.ne, impl.nf, impl.nefc - impl.ne - impl.nf]
    kind = np.repeat([_EQUALITY, _FRICTION, _ONE_SIDED], counts)
    friction = jnp.where(kind == _FRICTION, impl.efc_frictionloss, jnp.inf)

    def pad(x: jax.Array) -> jax.Array:
        """Add constraints that are never active, up to a multiple of the rows added at a time."""
        return jnp.pad(x, [(0, -len(x) % _rows(impl.efc_J)), *[(0, 0)] * (x.ndim - 1)])

    problem = _Problem(
        inertia=support.full_m(model, data),
        smooth=data.qacc_smooth,
        jacobian=pad(impl.efc_J),
        reference=pad(impl.efc_aref),
        stiffness=pad(impl.efc_D),
        low=pad(-friction),
        high=pad(jnp.where(kind == _ONE_SIDED, 0.0, friction)),
    )
    warm, smooth = data.qacc_warmstart, data.qacc_smooth
    start = _once(jnp.where(problem.cost(warm) < problem.cost(smooth), warm, smooth))

    def going_on(carry: _Carry) -> jax.Array:
        count, done = carry[0], carry[1]
        return ~done & (count < ITERATIONS)

    def newton(carry: _Carry) -> _Carry:
        count, _, acceleration, residual = carry
        piece = problem.piece(residual)
        weighted = problem.curvature(piece)[:, None] * problem.jacobian
        slope = problem.slope(residual)[:, None]
        total = _over_rows(problem.jacobian, jnp.concatenate([weighted, slope], axis=1))
        hessian = problem.inertia + total[:, :-1]
        gradient = problem.inertia @ (acceleration - problem.smooth) + total[:, -1]
        step = -elimination.solve(hessian, gradient)
        change = problem.jacobian @ step
        done = _once(jnp.all(problem.piece(residual + change) == piece))
        found = _line_search(problem, acceleration, residual, step, change)
        factor = _once(jnp.where(done, 1.0, found))
        return count + 1, done, acceleration + factor * step, residual + factor * change

    carry = (jnp.zeros((), jnp.int32), jnp.zeros((), bool), start, problem.residual(start))
    *_, acceleration, residual = jax.lax.while_loop(going_on, newton, carry)
    force = -problem.slope(residual)
    pull = _over_rows(problem.jacobian, force[:, None])[:, 0]
    return data.tree_replace(
        {
            "qacc": acceleration,
            "qfrc_constraint": pull,
            "_impl.efc_force": force[: impl.nefc],
        }
    )


def _once(value: jax.Array) -> jax.Array:
    """Have XLA compute a value once: a copy may round differently, and so decide otherwise."""
    return jax.lax.optimization_barrier(value)


def _rows(jacobian: jax.Array) -> int:
    length, columns = jacobian.shape
    return min(_ROWS, length) if columns <= _ROWS else length


def _over_rows(left: jax.Array, right: jax.Array) -> jax.Array:
    """Return ``left.T @ right``, some rows at a time: CPUs write short products out as sums."""

    def add(total: jax.Array, pieces: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        return total + pieces[0].T @ pieces[1], None

    rows = _rows(left)
    if rows == len(left):
        return left.T @ right
    pieces = left.reshape(-1, rows, left.shape[1]), right.reshape(-1, rows, right.shape[1])
    return jax.lax.scan(add, jnp.zeros((left.shape[1], right.shape[1])), pieces)[0]


def _line_search(
    problem: _Problem,
    acceleration: jax.Array,
    residual: jax.Array,
    step: jax.Array,
    change: jax.Array,
) -> jax.Array:
    """Return the factor of a step at which the cost is least."""
    inertia_step = problem.inertia @ step
    linear = inertia_step @ (acceleration - problem.smooth)
    quadratic = inertia_step @ step

    def derivatives(factor: jax.Array) -> tuple[jax.Array, jax.Array]:
        at = residual + factor * change
        first = linear + factor * quadratic + jnp.sum(problem.slope(at) * change)
        second = jnp.sum(problem.curvature(problem.piece(at)) * change * change)
        return first, quadratic + second

    def narrow(_: Any, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        """Newton's step between bounds, where the derivative is -, and +; else halfway."""
        factor, low, high = carry
        first, second = derivatives(factor)
        low = jnp.where(first < 0, factor, low)
        high = jnp.where(first > 0, factor, high)
        next_factor = factor - first / second
        halfway = jnp.where(jnp.isfinite(high), 0.5 * (low + high), 2 * factor)
        # Bounds included: at the least cost Newton's step is zero, and the factor stays.
        inside = (next_factor >= low) & (next_factor <= high)
        return jnp.where(inside, next_factor, halfway), low, high

    carry = (jnp.ones(()), jnp.zeros(()), jnp.full((), jnp.inf))
    return jax.lax.fori_loop(0, LINE_SEARCH_ITERATIONS, narrow, carry, unroll=True)[0]
