"""Constraint forces by Newton's method, with fewer and cheaper iterations than MuJoCo XLA's."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.physics.mujoco import elimination
from pixelbrax_jax.physics.mujoco.compatibility import import_silenced
from pixelbrax_jax.physics.mujoco.cones import Cones
from pixelbrax_jax.physics.mujoco.opengl import mujoco

with import_silenced():
    from mujoco.mjx._src import support

ITERATIONS = 16
"""Largest number of Newton's steps; the loop stops earlier after an exact step."""

LINE_SEARCH_ITERATIONS = 6
"""Largest number of steps of a line search."""

CONE_LINE_SEARCH_ITERATIONS = 8
"""The same with elliptic cones."""

_ROWS = 16
"""Rows of a matrix product that are added at a time, if it has at most as many columns."""

_EQUALITY, _FRICTION, _ONE_SIDED, _CONE = range(4)

_Carry = tuple[jax.Array, jax.Array, jax.Array, jax.Array]


class _Problem(NamedTuple):
    """Minimise ``(a - smooth) M (a - smooth) / 2 + sum(cost(J a - reference))`` over ``a``.

    The derivative of a constraint's cost is ``clip(stiffness * x, low, high)``. Equalities have no
    bounds, dry friction has those of its force, limits and contacts are at most 0. The constraints
    of ``cones``, from row ``first`` on, have stiffness 0 here and separate costs.
    """

    inertia: jax.Array
    smooth: jax.Array
    jacobian: jax.Array
    reference: jax.Array
    stiffness: jax.Array
    low: jax.Array
    high: jax.Array
    first: int = 0
    cones: Cones | None = None

    def residual(self, acceleration: jax.Array) -> jax.Array:
        return self.jacobian @ acceleration - self.reference

    def slope(self, residual: jax.Array) -> jax.Array:
        slope = self._clipped(residual)
        if self.cones is None:
            return slope
        return self._with_cones(slope, self.cones.slope(self._of_cones(residual)))

    def piece(self, residual: jax.Array) -> jax.Array:
        """Return 0 where costs are quadratic, -1 and 1 at bounds of the slope."""
        slope = self.stiffness * residual
        return (slope >= self.high).astype(jnp.int32) - (slope <= self.low).astype(jnp.int32)

    def curvature_times(self, residual: jax.Array, rows: jax.Array) -> jax.Array:
        """Return second derivatives times (R, V) rows."""
        curvature = jnp.where(self.piece(residual) == 0, self.stiffness, 0.0)
        weighted = curvature[:, None] * rows
        if self.cones is None:
            return weighted
        own = self.cones.curvature_times(self._of_cones(residual), self._of_cones(rows))
        return self._with_cones(weighted, own)

    def stays(self, residual: jax.Array, change: jax.Array) -> jax.Array:
        """Return whether costs up to the end of a step are as Newton's method assumed."""
        same = jnp.all(self.piece(residual + change) == self.piece(residual))
        if self.cones is None:
            return same
        at, by = self._of_cones(residual), self._of_cones(change)
        return same & self.cones.stay(at, by)

    def _clipped(self, residual: jax.Array) -> jax.Array:
        return jnp.clip(self.stiffness * residual, self.low, self.high)

    def _of_cones(self, rows: jax.Array) -> jax.Array:
        assert self.cones is not None
        shape = self.cones.scale.shape
        own = rows[self.first : self.first + shape[0] * shape[1]]
        return own.reshape(*shape, *rows.shape[1:])

    def _with_cones(self, rows: jax.Array, own: jax.Array) -> jax.Array:
        own = own.reshape(-1, *rows.shape[1:])
        return jnp.concatenate([rows[: self.first], own, rows[self.first + len(own) :]])

    def cost(self, acceleration: jax.Array) -> jax.Array:
        residual = self.residual(acceleration)
        slope = self._clipped(residual)
        away = acceleration - self.smooth
        least = slope * slope / jnp.maximum(2 * self.stiffness, mujoco.mjMINVAL)
        cost = 0.5 * away @ (self.inertia @ away) + jnp.sum(slope * residual - least)
        if self.cones is None:
            return cost
        return cost + self.cones.cost(self._of_cones(residual))


def solve(model: Any, data: Any) -> Any:
    """Find accelerations and constraint forces, as ``mujoco.mjx._src.solver.solve`` does.

    Costs are piecewise quadratic, so Newton's step is exact once the right constraints are active:
    the loop ends when a whole step does not change them. Costs of slipping contacts with elliptic
    cones are not quadratic: the loop ends when the forces after a whole step are as predicted.
    """
    impl = data._impl
    # MuJoCo's order: equalities, dry friction, then limits and contacts.
    cones = _cones(model, data)
    num_cones = 0 if cones is None else cones.scale.size
    counts = [impl.ne, impl.nf, impl.nefc - impl.ne - impl.nf - num_cones, num_cones]
    kind = np.repeat([_EQUALITY, _FRICTION, _ONE_SIDED, _CONE], counts)
    friction = jnp.where(kind == _FRICTION, impl.efc_frictionloss, jnp.inf)

    def pad(x: jax.Array) -> jax.Array:
        """Add constraints that are never active, up to a multiple of the rows added at a time."""
        return jnp.pad(x, [(0, -len(x) % _rows(impl.efc_J)), *[(0, 0)] * (x.ndim - 1)])

    problem = _Problem(
        inertia=support.full_m(model, data),
        smooth=data.qacc_smooth,
        jacobian=pad(impl.efc_J),
        reference=pad(impl.efc_aref),
        stiffness=pad(jnp.where(kind == _CONE, 0.0, impl.efc_D)),
        low=pad(-friction),
        high=pad(jnp.where(kind == _ONE_SIDED, 0.0, friction)),
        first=impl.nefc - num_cones,
        cones=cones,
    )
    warm, smooth = data.qacc_warmstart, data.qacc_smooth
    start = _once(jnp.where(problem.cost(warm) < problem.cost(smooth), warm, smooth))

    def going_on(carry: _Carry) -> jax.Array:
        count, done = carry[0], carry[1]
        return ~done & (count < ITERATIONS)

    def newton(carry: _Carry) -> _Carry:
        count, _, acceleration, residual = carry
        weighted = problem.curvature_times(residual, problem.jacobian)
        slope = problem.slope(residual)[:, None]
        total = _over_rows(problem.jacobian, jnp.concatenate([weighted, slope], axis=1))
        hessian = problem.inertia + total[:, :-1]
        gradient = problem.inertia @ (acceleration - problem.smooth) + total[:, -1]
        step = -elimination.solve(hessian, gradient)
        change = problem.jacobian @ step
        done = _once(problem.stays(residual, change))
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


def _cones(model: Any, data: Any) -> Cones | None:
    contact = data._impl.contact
    if model.opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC or not len(contact.dim):
        return None
    dimension = int(contact.dim[0])
    friction = contact.friction[:, : dimension - 1]
    mu = friction[:, :1] / jnp.sqrt(model.opt.impratio)
    stiffness = data._impl.efc_D[-len(contact.dim) * dimension :]
    return Cones(
        stiffness=stiffness.reshape(-1, dimension),
        scale=jnp.concatenate([mu, friction], axis=1),
    )


def _once(value: jax.Array) -> jax.Array:
    """Make XLA compute a value once, because a copy may round differently."""
    return jax.lax.optimization_barrier(value)


def _rows(jacobian: jax.Array) -> int:
    length, columns = jacobian.shape
    return min(_ROWS, length) if columns <= _ROWS else length


def _over_rows(left: jax.Array, right: jax.Array) -> jax.Array:
    """Return ``left.T @ right``; on a CPU some rows at a time: XLA makes sums of short products."""
    rows = _rows(left)

    def add(total: jax.Array, pieces: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        return total + pieces[0].T @ pieces[1], None

    def by_pieces(left: jax.Array, right: jax.Array) -> jax.Array:
        pieces = left.reshape(-1, rows, left.shape[1]), right.reshape(-1, rows, right.shape[1])
        return jax.lax.scan(add, jnp.zeros((left.shape[1], right.shape[1])), pieces)[0]

    def at_once(left: jax.Array, right: jax.Array) -> jax.Array:
        return left.T @ right

    if rows == len(left):
        return at_once(left, right)
    product: jax.Array = jax.lax.platform_dependent(left, right, cpu=by_pieces, default=at_once)
    return product


def _line_search(
    problem: _Problem,
    acceleration: jax.Array,
    residual: jax.Array,
    step: jax.Array,
    change: jax.Array,
) -> jax.Array:
    inertia_step = problem.inertia @ step
    linear = inertia_step @ (acceleration - problem.smooth)
    quadratic = inertia_step @ step

    def derivatives(factor: jax.Array) -> tuple[jax.Array, jax.Array]:
        at = residual + factor * change
        first = linear + factor * quadratic + jnp.sum(problem.slope(at) * change)
        second = jnp.sum(problem.curvature_times(at, change[:, None])[:, 0] * change)
        return first, quadratic + second

    def narrow(_: Any, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        """Take Newton's step if it lies between the bounds, else bisect."""
        factor, low, high = carry
        first, second = derivatives(factor)
        low = jnp.where(first < 0, factor, low)
        high = jnp.where(first > 0, factor, high)
        next_factor = factor - first / second
        halfway = jnp.where(jnp.isfinite(high), 0.5 * (low + high), 2 * factor)
        # Bounds are included: at the least cost Newton's step is zero.
        inside = (next_factor >= low) & (next_factor <= high)
        return jnp.where(inside, next_factor, halfway), low, high

    carry = (jnp.ones(()), jnp.zeros(()), jnp.full((), jnp.inf))
    count = LINE_SEARCH_ITERATIONS if problem.cones is None else CONE_LINE_SEARCH_ITERATIONS
    return jax.lax.fori_loop(0, count, narrow, carry, unroll=True)[0]
