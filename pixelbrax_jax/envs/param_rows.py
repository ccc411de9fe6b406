"""Parameters of a batch, with some arrays per environment and others shared."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from pixelbrax_jax.types import DynamicsRanges, EnvParams

_TWO_OR_THREE = "2 or 3"

_NAMES: dict[tuple[int | str, ...], str] = {
    (): """
        episode_length rig.fovy geoms.strings.length look.ambient look.diffuse look.specular
        look.highlight look.ground_pitch look.ground_mark look.headlight look.lamps.cos_cutoff
        look.lamps.diffuse look.lamps.highlight look.headlight_highlight look.reflectance
    """,
    (2,): " ".join(f"dynamics.{name}" for name in DynamicsRanges.__annotations__),
    (3,): "rig.track rig.eye rig.target rig.up look.light look.lamps.pos look.lamps.axis",
    (2, 3): "look.ground_rgb geoms.strings.ends",
    (_TWO_OR_THREE, 3): "look.sky",
    ("G", 3): "geoms.size geoms.pos",
    ("G", 4): "geoms.quat",
    ("P", 4): "geoms.planes",
    ("M", 3): "geoms.rgb",
    (6, "N", "N", 3): "look.sky_texture",
    ("C",): "clips.first clips.length",
    ("T", "H", "W"): "clips.packed",
}
"""Shapes of the parameters of one environment, as in ``types``."""

_SHAPES = {name: shape for shape, names in _NAMES.items() for name in names.split()}


@dataclass(frozen=True)
class ParamRows:
    """Parameters split into arrays with a row for each environment, and shared ones."""

    own: tuple[Any, ...]
    shared: tuple[Any, ...]
    is_own: tuple[bool, ...]
    tree: Any

    def join(self, own: Sequence[Any], shared: Sequence[Any] | None = None) -> EnvParams:
        """Return the parameters of one environment from its rows and the shared arrays."""
        rest = iter(self.shared if shared is None else shared)
        rows = iter(own)
        leaves = [next(rows) if is_own else next(rest) for is_own in self.is_own]
        return jax.tree.unflatten(self.tree, leaves)

    def of_row(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return ``function`` with rows in place of the parameters as last argument."""

        def of_row(*args: Any) -> Any:
            *others, own = args
            return function(*others, self.join(own))

        return of_row

    def mark(self, own: Any, shared: Any) -> Any:
        """Return a tree like the parameters, with ``own`` for arrays with rows, else ``shared``."""
        marks = [own if is_own else shared for is_own in self.is_own]
        return jax.tree.unflatten(self.tree, marks)


def split_params(params: EnvParams, num_envs: int) -> ParamRows:
    """Split parameters whose arrays have the shapes of ``EnvParams`` or a leading axis N."""
    found, tree = jax.tree_util.tree_flatten_with_path(params)
    geoms = params.geoms
    sizes = {"G": len(geoms.kind), "M": max(geoms.material, default=-1) + 1}
    sizes["P"] = sum(geoms.num_planes)
    is_own = tuple(_has_rows(path, np.shape(leaf), num_envs, sizes) for path, leaf in found)
    pairs = [(leaf, own) for (_, leaf), own in zip(found, is_own, strict=True)]
    return ParamRows(
        own=tuple(leaf for leaf, own in pairs if own),
        shared=tuple(leaf for leaf, own in pairs if not own),
        is_own=is_own,
        tree=tree,
    )


def _has_rows(
    path: tuple[Any, ...], shape: tuple[int, ...], num_envs: int, sizes: Mapping[str, int]
) -> bool:
    names = [key.name for key in path if hasattr(key, "name")]
    wanted = tuple(sizes.get(str(size), size) for size in _SHAPES[".".join(names)])
    if _fits(shape, wanted):
        return False
    if _fits(shape, (num_envs, *wanted)):
        return True
    raise ValueError(
        f"params{jax.tree_util.keystr(path)} must have shape {_written(wanted)}, the same for all "
        f"environments, or {_written((num_envs, *wanted))}, a row for each of the "
        f"num_envs={num_envs}; got {shape}."
    )


def _fits(shape: tuple[int, ...], wanted: tuple[int | str, ...]) -> bool:
    return len(shape) == len(wanted) and all(
        given in (2, 3) if size == _TWO_OR_THREE else isinstance(size, str) or size == given
        for given, size in zip(shape, wanted, strict=True)
    )


def _written(shape: tuple[int | str, ...]) -> str:
    return f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"
