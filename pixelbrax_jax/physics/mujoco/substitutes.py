"""Replacements for functions of MuJoCo XLA."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.physics.mujoco import elimination
from pixelbrax_jax.physics.mujoco.compatibility import import_silenced
from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.physics.mujoco.solver import is_supported, solve

with import_silenced():
    from mujoco.mjx._src import collision_driver, scan, smooth, support
    from mujoco.mjx._src import solver as mjx_solver
    from mujoco.mjx._src.types import GeomType

_PLANE_AND_CAPSULE = (GeomType.PLANE, GeomType.CAPSULE)
_plane_capsule = collision_driver._COLLISION_FUNC[_PLANE_AND_CAPSULE]
_factor_m, _solve_m = smooth.factor_m, smooth.solve_m
_body_tree = scan.body_tree

_SHORT = 5
"""Longest chain of bodies whose positions XLA may compute in one loop."""

_lock = threading.RLock()


@contextmanager
def substituted(model: mujoco.MjModel) -> Iterator[None]:
    """Trace steps of a model with replacements for some functions of MuJoCo XLA.

    Programs of MuJoCo XLA that another thread traces during the block also get the replacements.
    """
    changes: list[tuple[dict[Any, Any], Any, Any]] = [
        (collision_driver._COLLISION_FUNC, _PLANE_AND_CAPSULE, plane_capsule),
        (vars(smooth), "factor_m", factor_m),
        (vars(smooth), "solve_m", solve_m),
    ]
    if _longest_chain(model) > _SHORT:
        changes.append((vars(scan), "body_tree", body_tree))
    if is_supported(model):
        changes.append((vars(mjx_solver), "solve", solve))
    with _lock:
        before = [functions[name] for functions, name, _ in changes]
        for functions, name, ours in changes:
            functions[name] = ours
        try:
            yield
        finally:
            for (functions, name, _), theirs in zip(changes, before, strict=True):
                functions[name] = theirs


def body_tree(model: Any, of_body: Any, *args: Any, **options: Any) -> Any:
    """Scan bodies like ``mujoco.mjx._src.scan.body_tree``, one level of the tree at a time.

    XLA on a CPU fuses the levels into one loop, which computes each body's parents several times:
    for a chain of fifteen bodies that takes ten thousand times as long.
    """

    def level(*values: Any) -> Any:
        barrier = jax.lax.optimization_barrier
        return jax.lax.platform_dependent(
            of_body(*values), cpu=barrier, default=lambda found: found
        )

    return _body_tree(model, level, *args, **options)


def _longest_chain(model: mujoco.MjModel) -> int:
    depth = [0]
    for parent in model.body_parentid[1:]:
        depth.append(depth[parent] + 1)
    return max(depth)


def factor_m(model: Any, data: Any) -> Any:
    """Factorise inertia like ``mujoco.mjx._src.smooth.factor_m``, after the solver has finished.

    On a CPU jaxlib 0.10.0 to 0.11.0 distribute a batch of factorisations among XLA's threads, and
    hang if as many batches as threads run at once. Euler's method factorises inertia with damping,
    which XLA would do in parallel to the solver; here it depends on the solver's accelerations.
    """
    inertia = data._impl.M

    def factors(inertia: jax.Array, acceleration: jax.Array) -> jax.Array:
        nothing = (0 * acceleration).sum()  # XLA does not know: it might be NaN.
        return _factor_m(model, data.tree_replace({"_impl.M": inertia + nothing}))._impl.qLD

    def no_factors(inertia: jax.Array, acceleration: jax.Array) -> jax.Array:
        # NaN, in case a program that another thread traces in the meantime reads the factors.
        del acceleration
        return jnp.full_like(inertia, jnp.nan)

    if _is_small(model):
        found = jax.lax.platform_dependent(inertia, data.qacc, cpu=no_factors, default=factors)
        return data.tree_replace({"_impl.qLD": found})
    nothing = (0 * data.qacc).sum()
    return _factor_m(model, data.tree_replace({"_impl.M": inertia + nothing}))


def solve_m(model: Any, data: Any, right: Any) -> Any:
    """Solve for inertia like ``mujoco.mjx._src.smooth.solve_m``, without factors on a CPU."""
    if not _is_small(model):
        return _solve_m(model, data, right)

    def by_factors(inertia: jax.Array, factors: jax.Array, right: jax.Array) -> jax.Array:
        del inertia
        return _solve_m(model, data.tree_replace({"_impl.qLD": factors}), right)

    def by_elimination(inertia: jax.Array, factors: jax.Array, right: jax.Array) -> jax.Array:
        del factors
        return elimination.eliminate(inertia, right)

    arguments = data._impl.M, data._impl.qLD, right
    return jax.lax.platform_dependent(*arguments, cpu=by_elimination, default=by_factors)


def _is_small(model: Any) -> bool:
    return not support.is_sparse(model) and model.nv <= elimination.LARGEST


def plane_capsule(model: Any, data: Any, key: Any, geom: jax.Array) -> tuple[jax.Array, ...]:
    """Collide planes with capsules as MuJoCo XLA does, but with MuJoCo's contact frames.

    The friction cone is a pyramid, so the direction of its edges matters. MuJoCo points the first
    edge along the capsule, MuJoCo XLA along a world axis if the capsule is steeper than 60 degrees;
    this changes single control steps of the humanoid by up to 0.3 rad/s.
    """
    dist, pos, frame = _plane_capsule(model, data, key, geom)
    normal = data.geom_xmat[geom[:, 0]][:, :, 2]
    axis = data.geom_xmat[geom[:, 1]][:, :, 2]
    along = axis - normal * jnp.sum(normal * axis, axis=-1, keepdims=True)
    length = jnp.linalg.norm(along, axis=-1, keepdims=True)
    along = along / jnp.maximum(length, 1e-6)
    ours = jnp.stack([normal, along, jnp.cross(normal, along)], axis=1)
    # An upright capsule has no direction. Both of its ends have the same frame.
    ours = jnp.where(length[:, :, None] > 1e-6, ours, frame[::2])
    return dist, pos, jnp.repeat(ours, 2, axis=0)


plane_capsule.ncon = _plane_capsule.ncon  # type: ignore[attr-defined]
