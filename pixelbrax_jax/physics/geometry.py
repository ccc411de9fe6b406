"""Visible shapes of a MuJoCo model."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.physics.opengl import mujoco
from pixelbrax_jax.physics.task import Color
from pixelbrax_jax.types import GeomKind, Geoms
from pixelbrax_jax.validation import check_choice

# MuJoCo's viewer shows these groups by default.
VISIBLE_GROUPS = (0, 1, 2)

_DEFAULT_RGBA = np.array([0.5, 0.5, 0.5, 1.0], np.float32)


class Shape(NamedTuple):
    """One visible shape; fields as in ``Geoms``, with its color and its material's name."""

    kind: GeomKind
    link: int
    name: str
    size: np.ndarray
    pos: np.ndarray
    quat: np.ndarray
    rgb: Color
    material: str = ""
    bounded: bool = False
    patterned: bool = False


def as_geoms(shapes: Sequence[Shape]) -> Geoms:
    """Return shapes as ``Geoms``.

    Shapes of equal color share a material. Planes never share one with other kinds, so that the
    ground can be recolored separately.
    """
    materials: dict[tuple[bool, tuple[float, ...]], str] = {}
    keys = []
    for shape in shapes:
        rgb = tuple(np.asarray(shape.rgb, np.float32).tolist())
        keys.append((shape.kind == GeomKind.PLANE, rgb))
        materials.setdefault(keys[-1], shape.material)
    rows = list(materials)

    def stack(arrays: Iterable[object]) -> jnp.ndarray:
        return jnp.asarray(np.stack([np.asarray(array, np.float32) for array in arrays]))

    return Geoms(
        kind=tuple(int(shape.kind) for shape in shapes),
        link=tuple(shape.link for shape in shapes),
        material=tuple(map(rows.index, keys)),
        name=tuple(shape.name for shape in shapes),
        size=stack(shape.size for shape in shapes),
        pos=stack(shape.pos for shape in shapes),
        quat=stack(shape.quat for shape in shapes),
        rgb=stack(rgb for _, rgb in rows),
        bounded=tuple(shape.bounded for shape in shapes),
        patterned=tuple(shape.patterned for shape in shapes),
        material_name=tuple(materials.values()) if any(materials.values()) else (),
    )


def geom_shapes(
    model: mujoco.MjModel,
    *,
    colors: Mapping[str, Color] | None = None,
    drawn_radius: Mapping[str, float] | None = None,
    geom_groups: Collection[int] = VISIBLE_GROUPS,
) -> list[Shape]:
    """Return the geoms that MuJoCo's viewer shows, without textures, in the model's order.

    Geoms of hidden groups or with alpha 0 are left out; any other alpha is opaque. Planes are
    infinite, and ground.

    Args:
        model: a compiled model; link i is its body i + 1.
        colors: replacements by geom name, red, green, blue in [0, 1].
        drawn_radius: metres, by name of a sphere to render larger than it is, so that it is visible
            in small images. Physics ignores it.
        geom_groups: the visible groups.

    Raises:
        ValueError: a name or value in ``colors`` or ``drawn_radius`` is wrong, the renderer does
            not support a visible geom, flex or skin, or nothing is visible.
    """
    names = [_name(model, i) for i in range(model.ngeom)]
    colors, drawn_radius = dict(colors or {}), dict(drawn_radius or {})
    for name, color in colors.items():
        check_choice("geom", name, names)
        if np.shape(color) != (3,) or not all(0 <= c <= 1 for c in color):
            raise ValueError(
                f"color of geom {name!r} must be three numbers in [0, 1], got {color!r}"
            )
    for name, radius in drawn_radius.items():
        check_choice("geom", name, names)
        shape = _kind_name(model, names.index(name))
        if shape != "sphere" or not radius > 0:
            raise ValueError(
                f"drawn_radius must be a positive number for a sphere, got {radius!r} for geom "
                f"{name!r}, a {shape}."
            )
    _check_surfaces(model, geom_groups)
    shapes = []
    for i in shown_geoms(model, geom_groups):
        kind, name = _kind(model, i, names[i]), names[i]
        size = sizes(kind, model.geom_size[i])
        size[0] = drawn_radius.get(name, size[0])
        shapes.append(
            Shape(
                kind=kind,
                # Link 0 is MuJoCo's body 1, because the world is not a link.
                link=int(model.geom_bodyid[i]) - 1,
                name=name,
                size=size,
                pos=model.geom_pos[i],
                quat=model.geom_quat[i],
                rgb=colors.get(name, tuple(geom_rgba(model, i)[:3])),
                patterned=kind == GeomKind.PLANE,
            )
        )
    if not shapes:
        raise ValueError(
            f"no geom is visible: all have alpha 0 or a group outside {tuple(geom_groups)}"
        )
    return shapes


def site_shapes(model: mujoco.MjModel, groups: Collection[int] = VISIBLE_GROUPS) -> Iterator[Shape]:
    """Yield the sites that MuJoCo's viewer shows, as ``site/<name>``."""
    for i in range(model.nsite):
        rgba = resolve_rgba(model, model.site_rgba[i], model.site_matid[i])
        if model.site_group[i] not in groups or not rgba[3] > 0:
            continue
        kind = GeomKind(int(model.site_type[i]))
        yield Shape(
            kind=kind,
            link=int(model.site_bodyid[i]) - 1,
            name=f"site/{model.site(i).name or i}",
            size=sizes(kind, model.site_size[i]),
            pos=model.site_pos[i],
            quat=model.site_quat[i],
            rgb=tuple(rgba[:3]),
            material=material_name(model, model.site_matid[i]),
        )


def sizes(kind: GeomKind, numbers: np.ndarray) -> np.ndarray:
    """Return (3,) float32 sizes, with 0 for unused entries."""
    size = np.array(numbers, np.float32)
    size[kind.num_sizes :] = 0
    return size


def material_name(model: mujoco.MjModel, index: int) -> str:
    """Return a material's name, empty for none."""
    return str(model.material(index).name) if index >= 0 else ""


def _name(model: mujoco.MjModel, index: int) -> str:
    return model.geom(index).name or f"{_kind_name(model, index)}/{index}"


def _kind_name(model: mujoco.MjModel, index: int) -> str:
    return mujoco.mjtGeom(int(model.geom_type[index])).name.removeprefix("mjGEOM_").lower()


def _kind(model: mujoco.MjModel, index: int, name: str) -> GeomKind:
    kind = _kind_name(model, index)
    if kind.upper() not in GeomKind.__members__:
        raise ValueError(
            f"geom {name!r} is a {kind}, which cannot be rendered; supported: "
            f"{', '.join(k.name.lower() for k in GeomKind)}. Replace it by these primitives, "
            f"hide it with alpha 0, or leave its group ({int(model.geom_group[index])}) out of "
            "geom_groups."
        )
    return GeomKind[kind.upper()]


def _check_surfaces(model: mujoco.MjModel, groups: Collection[int]) -> None:
    flexes = (mujoco.mjtObj.mjOBJ_FLEX, model.nflex, model.flex_group, model.flex_rgba)
    skins = (mujoco.mjtObj.mjOBJ_SKIN, model.nskin, model.skin_group, model.skin_rgba)
    for element, count, group, rgba in (flexes, skins):
        kind = element.name.removeprefix("mjOBJ_").lower()
        for i in range(count):
            if group[i] in groups and rgba[i, 3] > 0:
                name = mujoco.mj_id2name(model, element, i) or f"{kind}/{i}"
                raise ValueError(
                    f"{kind} {name!r} cannot be rendered: hide it with alpha 0, leave its group "
                    f"({int(group[i])}) out of geom_groups, or remove it from the model."
                )


def shown_geoms(model: mujoco.MjModel, geom_groups: Collection[int] = VISIBLE_GROUPS) -> list[int]:
    """Return indices of the geoms that ``geom_shapes`` returns, in its order."""
    groups = model.geom_group
    return [
        i for i in range(model.ngeom) if groups[i] in geom_groups and geom_rgba(model, i)[3] > 0
    ]


def geom_rgba(model: mujoco.MjModel, index: int) -> np.ndarray:
    """Return (4,) float32, the color of a geom or of its material."""
    return resolve_rgba(model, model.geom_rgba[index], int(model.geom_matid[index]))


def resolve_rgba(model: mujoco.MjModel, own: np.ndarray, material: int) -> np.ndarray:
    """Return (4,) float32: the material's color if the element has MuJoCo's default rgba."""
    return model.mat_rgba[material] if material >= 0 and (own == _DEFAULT_RGBA).all() else own
