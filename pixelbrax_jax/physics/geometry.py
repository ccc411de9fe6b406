"""Visible shapes of a MuJoCo model."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.physics.opengl import mujoco
from pixelbrax_jax.physics.task import Color
from pixelbrax_jax.types import GeomKind, Geoms
from pixelbrax_jax.validation import check_choice

# MuJoCo's viewer shows these groups by default.
VISIBLE_GROUPS = (0, 1, 2)

_DEFAULT_RGBA = np.array([0.5, 0.5, 0.5, 1.0], np.float32)


def read_geoms(
    model: mujoco.MjModel,
    *,
    colors: Mapping[str, Color] | None = None,
    drawn_radius: Mapping[str, float] | None = None,
    geom_groups: Collection[int] = VISIBLE_GROUPS,
) -> Geoms:
    """Return the geoms MuJoCo's viewer would show, without textures.

    A geom is left out if its group is not shown or its alpha is 0; any other alpha counts as
    opaque. Geoms of equal color share a material, except that planes never share one with
    other kinds, so that a ground can be recolored alone.

    Args:
        model: a compiled model; link i is its body i + 1.
        colors: replacements by geom name, red, green, blue in [0, 1].
        drawn_radius: metres, replacements by name of a sphere that is drawn larger than it
            is, because it would be lost in a small image. Physics does not see it.
        geom_groups: the groups shown.

    Returns:
        The shapes in the model's order.

    Raises:
        ValueError: for an unknown name or a bad value in ``colors`` or ``drawn_radius``, for a
            visible geom, flex or skin that the renderer has no formula for, or if nothing is
            visible.
    """
    colors = dict(colors or {})
    names = [_name(model, i) for i in range(model.ngeom)]
    for name, color in colors.items():
        check_choice("geom", name, names)
        if np.shape(color) != (3,) or not all(0 <= c <= 1 for c in color):
            raise ValueError(
                f"color of geom {name!r} must be three numbers in [0, 1], got {color!r}"
            )
    drawn_radius = dict(drawn_radius or {})
    for name, radius in drawn_radius.items():
        check_choice("geom", name, names)
        shape = _kind_name(model, names.index(name))
        if shape != "sphere" or not radius > 0:
            raise ValueError(
                f"drawn_radius must be a positive number for a sphere, got {radius!r} for geom "
                f"{name!r}, a {shape}."
            )
    _check_surfaces(model, geom_groups)

    shown = shown_geoms(model, geom_groups)
    if not shown:
        raise ValueError(
            f"no geom is visible: all have alpha 0 or a group outside {tuple(geom_groups)}"
        )
    kinds = [_kind(model, i, names[i]) for i in shown]

    materials: dict[tuple[bool, Color], int] = {}
    rows = []
    for i, kind in zip(shown, kinds, strict=True):
        red, green, blue = (float(c) for c in colors.get(names[i], _rgba(model, i)[:3]))
        key = (kind == GeomKind.PLANE, (red, green, blue))
        rows.append(materials.setdefault(key, len(materials)))

    size = np.array(model.geom_size[shown], np.float32)
    for row, i, kind in zip(size, shown, kinds, strict=True):
        row[kind.num_sizes :] = 0
        row[0] = drawn_radius.get(names[i], row[0])
    return Geoms(
        kind=tuple(int(kind) for kind in kinds),
        # Brax's link 0 is MuJoCo's body 1, because the world is no link.
        link=tuple(int(model.geom_bodyid[i]) - 1 for i in shown),
        material=tuple(rows),
        name=tuple(names[i] for i in shown),
        size=jnp.asarray(size),
        pos=jnp.asarray(model.geom_pos[shown], jnp.float32),
        quat=jnp.asarray(model.geom_quat[shown], jnp.float32),
        rgb=jnp.asarray([color for _, color in materials], jnp.float32),
    )


def _name(model: mujoco.MjModel, index: int) -> str:
    return model.geom(index).name or f"{_kind_name(model, index)}/{index}"


def _kind_name(model: mujoco.MjModel, index: int) -> str:
    return mujoco.mjtGeom(int(model.geom_type[index])).name.removeprefix("mjGEOM_").lower()


def _kind(model: mujoco.MjModel, index: int, name: str) -> GeomKind:
    kind = _kind_name(model, index)
    if kind.upper() not in GeomKind.__members__:
        raise ValueError(
            f"geom {name!r} is a {kind}, which cannot be drawn; supported: "
            f"{', '.join(k.name.lower() for k in GeomKind)}. Replace it by these primitives, "
            f"hide it with alpha 0, or leave its group ({int(model.geom_group[index])}) out of "
            "geom_groups."
        )
    return GeomKind[kind.upper()]


def _check_surfaces(model: mujoco.MjModel, groups: Collection[int]) -> None:
    """Raise an error for a visible flex or skin."""
    flexes = (mujoco.mjtObj.mjOBJ_FLEX, model.nflex, model.flex_group, model.flex_rgba)
    skins = (mujoco.mjtObj.mjOBJ_SKIN, model.nskin, model.skin_group, model.skin_rgba)
    for element, count, group, rgba in (flexes, skins):
        kind = element.name.removeprefix("mjOBJ_").lower()
        for i in range(count):
            if group[i] in groups and rgba[i, 3] > 0:
                name = mujoco.mj_id2name(model, element, i) or f"{kind}/{i}"
                raise ValueError(
                    f"{kind} {name!r} cannot be drawn: hide it with alpha 0, leave its group "
                    f"({int(group[i])}) out of geom_groups, or remove it from the model."
                )


def shown_geoms(model: mujoco.MjModel, geom_groups: Collection[int] = VISIBLE_GROUPS) -> list[int]:
    """Return indices of the geoms that ``read_geoms`` returns, in its order."""
    return [
        i
        for i in range(model.ngeom)
        if model.geom_group[i] in geom_groups and _rgba(model, i)[3] > 0
    ]


def resolve_rgba(model: mujoco.MjModel, own: np.ndarray, material: int) -> np.ndarray:
    """Return (4,) float32: a material colors what has MuJoCo's default rgba itself."""
    return model.mat_rgba[material] if material >= 0 and (own == _DEFAULT_RGBA).all() else own


def _rgba(model: mujoco.MjModel, index: int) -> np.ndarray:
    return resolve_rgba(model, model.geom_rgba[index], int(model.geom_matid[index]))
