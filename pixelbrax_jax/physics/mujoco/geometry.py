"""Visible shapes of a MuJoCo model."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.physics.task import Color
from pixelbrax_jax.types import GeomKind, Geoms
from pixelbrax_jax.validation import check_choice

# MuJoCo's viewer shows these groups by default.
VISIBLE_GROUPS = (0, 1, 2)

DEFAULT_RGBA = np.array([0.5, 0.5, 0.5, 1.0], np.float32)


class Shape(NamedTuple):
    """One visible shape; fields as in ``Geoms``, with its color and its material's name.

    ``row`` is its index among the model's geoms or sites. ``planes`` are the (K, 4) half-spaces of
    a mesh, as in ``Geoms``, and ``error`` is their largest distance from its convex hull in metres.
    Shapes with different ``owner`` share no color.
    """

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
    textured: bool = False
    row: int = -1
    planes: np.ndarray | None = None
    error: float = 0.0
    owner: str = ""


def as_geoms(shapes: Sequence[Shape]) -> Geoms:
    """Return shapes as ``Geoms``; equal colors share a material, except planes with other kinds."""
    materials: dict[tuple[bool, str, tuple[float, ...]], str] = {}
    keys = []
    for shape in shapes:
        rgb = tuple(np.asarray(shape.rgb, np.float32).tolist())
        keys.append((shape.kind == GeomKind.PLANE, shape.owner, rgb))
        materials.setdefault(keys[-1], shape.material)
    rows = list(materials)
    planes = [shape.planes for shape in shapes if shape.planes is not None]
    counts = tuple(0 if shape.planes is None else len(shape.planes) for shape in shapes)

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
        rgb=stack(rgb for *_, rgb in rows),
        bounded=tuple(shape.bounded for shape in shapes),
        patterned=tuple(shape.patterned for shape in shapes),
        textured=tuple(shape.textured for shape in shapes),
        num_planes=counts if planes else (),
        planes=jnp.asarray(np.concatenate(planes)) if planes else None,
        material_name=tuple(materials.values()) if any(materials.values()) else (),
    )


def hull_errors(shapes: Sequence[Shape]) -> dict[str, float]:
    """Return ``Shape.error`` of each mesh by name, in metres."""
    return {shape.name: shape.error for shape in shapes if shape.kind == GeomKind.MESH}


def geom_shapes(
    model: mujoco.MjModel,
    *,
    colors: Mapping[str, Color] | None = None,
    drawn_radius: Mapping[str, float] | None = None,
    geom_groups: Collection[int] = VISIBLE_GROUPS,
) -> list[Shape]:
    """Return the geoms that MuJoCo's viewer shows, without textures, in the model's order.

    Geoms of hidden groups or with alpha 0 are left out; any other alpha is opaque. Planes are
    infinite, and ground. Meshes are convex hulls of few faces, see ``hulls``. Link i is body i + 1.

    ``colors`` replaces colors, red, green, blue in [0, 1], by geom name. ``drawn_radius``, metres
    by name of a sphere, renders it larger than it is, so that it is visible in small images;
    physics ignores it. A ValueError names what is wrong with them, or cannot be rendered.
    """
    kinds = [_kind_name(kind) for kind in model.geom_type]
    names = [model.geom(i).name or f"{kind}/{i}" for i, kind in enumerate(kinds)]
    colors, drawn_radius = dict(colors or {}), dict(drawn_radius or {})
    for name, color in colors.items():
        check_choice("geom", name, names)
        if np.shape(color) != (3,) or not all(0 <= c <= 1 for c in color):
            raise ValueError(
                f"color of geom {name!r} must be three numbers in [0, 1], got {color!r}"
            )
    for name, radius in drawn_radius.items():
        check_choice("geom", name, names)
        kind = kinds[names.index(name)]
        if kind != "sphere" or not radius > 0:
            raise ValueError(
                f"drawn_radius must be a positive number for a sphere, got {radius!r} for geom "
                f"{name!r}, a {kind}."
            )
    _check_kinds(model, geom_groups)
    shapes = []
    for shape in _shown(model, "geom", geom_groups):
        shape.size[0] = drawn_radius.get(shape.name, shape.size[0])
        rgb = colors.get(shape.name, shape.rgb)
        shapes.append(shape._replace(rgb=rgb, patterned=shape.kind == GeomKind.PLANE))
    if not shapes:
        raise ValueError(
            f"no geom is visible: all have alpha 0 or a group outside {tuple(geom_groups)}"
        )
    return shapes


def site_shapes(model: mujoco.MjModel, groups: Collection[int] = VISIBLE_GROUPS) -> list[Shape]:
    """Return the sites that MuJoCo's viewer shows, as ``site/<name>``."""
    return list(_shown(model, "site", groups))


def translucent(model: mujoco.MjModel, groups: Collection[int]) -> list[str]:
    """Return what is visible with an alpha below 1, such as ``geom 'glass'``, in model order."""
    found = []
    for element in ("geom", "site"):
        for i in range(getattr(model, f"n{element}")):
            it = getattr(model, element)(i)
            rgba = resolve_rgba(model, it.rgba, it.matid.item())
            if _is_visible(it.group.item(), rgba, groups) and rgba[3] < 1:
                found.append(f"{element} {it.name or i!r}")
    return found


def _is_visible(group: int, rgba: np.ndarray, groups: Collection[int]) -> bool:
    return group in groups and rgba[3] > 0


def _shown(model: mujoco.MjModel, element: str, groups: Collection[int]) -> Iterator[Shape]:
    """Yield the visible elements, ``geom`` or ``site``, in the model's order."""

    def field(name: str) -> Any:
        return getattr(model, f"{element}_{name}")[i]

    for i in range(getattr(model, f"n{element}")):
        rgba = resolve_rgba(model, field("rgba"), field("matid"))
        if not _is_visible(field("group"), rgba, groups):
            continue
        kind_name, own_name = _kind_name(field("type")), getattr(model, element)(i).name
        prefix = "site" if element == "site" else kind_name
        name = own_name if own_name and element == "geom" else f"{prefix}/{own_name or i}"
        kind = GeomKind[kind_name.upper()]
        size, planes, error = np.array(field("size"), np.float32), None, 0.0
        if kind == GeomKind.MESH:
            # SciPy takes a third of a second to import.
            from pixelbrax_jax.physics.mujoco.hulls import mesh_hull

            planes, size[0], error = mesh_hull(model, int(field("dataid")))
        size[kind.num_sizes :] = 0
        yield Shape(
            kind=kind,
            # Link 0 is MuJoCo's body 1, because the world is not a link.
            link=int(field("bodyid")) - 1,
            name=name,
            size=size,
            pos=field("pos"),
            quat=field("quat"),
            rgb=tuple(rgba[:3]),
            material=material_name(model, field("matid")),
            row=i,
            planes=planes,
            error=error,
        )


def material_name(model: mujoco.MjModel, index: int) -> str:
    """Return a material's name, empty for none."""
    return str(model.material(index).name) if index >= 0 else ""


def _kind_name(number: int) -> str:
    return mujoco.mjtGeom(int(number)).name.removeprefix("mjGEOM_").lower()


def _check_kinds(model: mujoco.MjModel, groups: Collection[int]) -> None:
    """Raise a ValueError that names all visible elements without a formula."""
    found = []
    objects = (
        ("geom", mujoco.mjtObj.mjOBJ_GEOM),
        ("flex", mujoco.mjtObj.mjOBJ_FLEX),
        ("skin", mujoco.mjtObj.mjOBJ_SKIN),
    )
    for element, number in objects:
        groups_of, colors = getattr(model, f"{element}_group"), getattr(model, f"{element}_rgba")
        for i, (group, rgba) in enumerate(zip(groups_of, colors, strict=True)):
            kind, shown = element, rgba
            if element == "geom":
                kind = _kind_name(model.geom_type[i])
                shown = resolve_rgba(model, rgba, model.geom_matid[i])
            is_known = kind.upper() in GeomKind.__members__
            if group in groups and shown[3] > 0 and not is_known:
                name = mujoco.mj_id2name(model, number, i) or f"{kind}/{i}"
                found.append(f"{kind} {name!r} (group {group})")
    if found:
        raise ValueError(
            f"cannot be rendered: {', '.join(found)}. Supported geoms: "
            f"{', '.join(kind.name.lower() for kind in GeomKind)}. Replace the others by these, "
            "hide them with alpha 0, leave their groups out of geom_groups, or remove them from "
            "the model."
        )


def resolve_rgba(model: mujoco.MjModel, own: np.ndarray, material: int) -> np.ndarray:
    """Return (4,) float32: the material's color if the element has MuJoCo's default rgba."""
    return model.mat_rgba[material] if material >= 0 and (own == DEFAULT_RGBA).all() else own
