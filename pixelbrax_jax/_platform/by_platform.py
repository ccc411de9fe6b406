"""Functions with a form for each platform; only the lowered form is traced."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax.extend import core
from jax.interpreters import ad, batching, mlir

from pixelbrax_jax.flags import default_flags, is_key

_Form = Callable[..., Any]
_Result = TypeVar("_Result")


def by_platform(
    arguments: tuple[Any, ...],
    like: Any,
    *,
    default: _Form,
    cpu: _Form | None = None,
    cuda: _Form | None = None,
    tpu: _Form | None = None,
    no_derivative: str = "",
) -> Any:
    """Call the platform's form with the arguments, like ``jax.lax.platform_dependent``.

    That function traces all forms, and ``jax.vmap`` traces them again. Here only the platform's
    form is traced, when the program is lowered; a derivative traces all. So a form may not close
    over values of the program; ``traced`` turns these into arguments. ``like`` has the shapes and
    dtypes of the results; ``no_derivative`` is the error message if there is no derivative.
    """
    leaves, tree = jax.tree.flatten(arguments)
    shapes, result_tree = jax.tree.flatten(like)
    # The program is lowered after the context of this call has ended.
    precision = getattr(jax.config, "jax_default_matmul_precision", None)

    def flat(form: _Form) -> _Form:
        def of_leaves(*leaves: Any) -> list[Any]:
            with default_flags(), jax.default_matmul_precision(precision):
                return jax.tree.leaves(form(*jax.tree.unflatten(tree, leaves)))

        return of_leaves

    forms = {"cpu": cpu, "cuda": cuda, "tpu": tpu}
    named = {name: flat(form) for name, form in forms.items() if form is not None}
    arrays = [jnp.asarray(x) for x in leaves]
    all_forms = _Forms(flat(default), named, no_derivative)
    if getattr(jax.config, "jax_debug_key_reuse", False) and any(is_key(x.dtype) for x in arrays):
        # The check counts an unknown primitive as a use of its keys.
        results = _by_jax(*arrays, forms=all_forms)
    else:
        results = _primitive.bind(
            *arrays, forms=all_forms, shapes=tuple((x.shape, x.dtype) for x in shapes)
        )
    return jax.tree.unflatten(result_tree, results)


def computed_once(
    compute: Callable[..., _Result], arguments: tuple[Any, ...], like: Any
) -> _Result:
    """Return ``compute(*arguments)``; XLA would otherwise recompute it for each reader.

    ``compute`` and ``like`` are as in ``by_platform``.
    """
    return by_platform(
        arguments,
        like,
        cpu=lambda *given: in_a_conditional(lambda _: compute(*given), like),
        default=lambda *given: jax.lax.optimization_barrier(compute(*given)),
    )


def in_a_conditional(compute: Callable[[jax.Array], _Result], like: Any) -> _Result:
    """Return ``compute(zero)`` so that XLA for CPUs does not fuse it into its readers.

    XLA fuses across barriers but not conditionals. ``zero`` is () int32 behind a barrier, so that
    XLA keeps the conditional. ``like`` has the shapes and dtypes of the result.
    """
    zero = jax.lax.optimization_barrier(jnp.int32(0))
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    # JAX batches a branch twice under ``jax.vmap``, and a program of ``jax.jit`` once.
    return jax.lax.cond(zero == 0, lambda: jax.jit(compute)(zero), lambda: blank)


class Traced(NamedTuple):
    """A function that has been traced; ``like`` has its results' shapes and dtypes.

    ``compute`` takes ``program``'s constants, which may be tracers, then the function's arguments.
    """

    program: core.ClosedJaxpr
    compute: Callable[..., Any]
    like: Any


def traced(function: Callable[..., Any], *like: Any) -> Traced:
    """Trace a function for arguments with these shapes and dtypes."""
    program, shapes = jax.make_jaxpr(function, return_shape=True)(*like)
    jaxpr, tree = program.jaxpr, jax.tree.structure(shapes)

    def compute(consts: list[Any], *arguments: Any) -> Any:
        evaluate = core.jaxpr_as_fun(core.ClosedJaxpr(jaxpr, consts))
        return jax.tree.unflatten(tree, evaluate(*jax.tree.leaves(arguments)))

    return Traced(program, compute, shapes)


def traced_row(function: Callable[..., Any], *batches: Any) -> Traced:
    """Trace a function for one row of each batch; ``like`` describes the results of all rows."""
    num_rows = len(jax.tree.leaves(batches)[0])
    row = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), batches)
    program, compute, like = traced(function, *row)
    all_rows = jax.tree.map(lambda x: jax.ShapeDtypeStruct((num_rows, *x.shape), x.dtype), like)
    return Traced(program, compute, all_rows)


@dataclass(frozen=True, eq=False)
class _Forms:
    default: _Form
    named: Mapping[str, _Form]
    no_derivative: str

    def map(self, change: Callable[[_Form], _Form]) -> _Forms:
        named = {name: change(form) for name, form in self.named.items()}
        return _Forms(change(self.default), named, self.no_derivative)


_primitive = core.Primitive("by_platform")
_primitive.multiple_results = True


@_primitive.def_impl
def _by_jax(*arrays: Any, forms: _Forms, shapes: Any = ()) -> Any:
    """Compute outside of programs, or trace all forms."""
    del shapes
    return jax.lax.platform_dependent(*arrays, default=forms.default, **forms.named)


@_primitive.def_abstract_eval
def _shapes(*avals: Any, forms: _Forms, shapes: Sequence[tuple[Any, Any]]) -> list[Any]:
    del forms
    aval = max(avals, key=num_varying)
    return [aval.update(shape=s, dtype=dtype, weak_type=False) for s, dtype in shapes]


def num_varying(aval: Any) -> int:
    """Return how many axes of ``jax.shard_map`` are known to vary."""
    return len(getattr(getattr(aval, "manual_axis_type", None), "varying", ()))


def _batch(arrays: Any, axes: Any, *, forms: _Forms, shapes: Sequence[tuple[Any, Any]]) -> Any:
    (size,) = {x.shape[axis] for x, axis in zip(arrays, axes, strict=True) if axis is not None}
    results = _primitive.bind(
        *arrays,
        forms=forms.map(lambda form: jax.vmap(form, in_axes=axes)),
        shapes=tuple(((size, *shape), dtype) for shape, dtype in shapes),
    )
    return results, [0] * len(results)


def _derivative(primals: Any, tangents: Any, *, forms: _Forms, shapes: Any) -> Any:
    del shapes
    if forms.no_derivative:
        raise NotImplementedError(forms.no_derivative)
    varied = [i for i, tangent in enumerate(tangents) if not isinstance(tangent, ad.Zero)]

    def compute(*some: Any) -> Any:
        leaves = list(primals)
        for i, leaf in zip(varied, some, strict=True):
            leaves[i] = leaf
        return _by_jax(*leaves, forms=forms)

    results, changes = jax.jvp(compute, [primals[i] for i in varied], [tangents[i] for i in varied])
    return results, [
        ad.Zero(jax.typeof(x).to_tangent_aval()) if change.dtype == jax.dtypes.float0 else change
        for x, change in zip(results, changes, strict=True)
    ]


def _lower(platform: str, ctx: Any, *values: Any, forms: _Forms, shapes: Any) -> Any:
    form = forms.named.get(platform, forms.default)

    def checked(*leaves: Any) -> list[Any]:
        results = form(*leaves)
        found = tuple((x.shape, x.dtype) for x in results)
        assert found == shapes, f"{form} gave {found} in place of {shapes}"
        return results

    return mlir.lower_fun(checked, multiple_results=True)(ctx, *values)


batching.primitive_batchers[_primitive] = _batch
ad.primitive_jvps[_primitive] = _derivative
mlir.register_lowering(_primitive, partial(_lower, ""))
for _platform in ("cpu", "cuda", "tpu"):
    mlir.register_lowering(_primitive, partial(_lower, _platform), platform=_platform)
