"""All that a MuJoCo model says about its own picture: shapes, cameras, lights."""

from __future__ import annotations

from collections.abc import Collection
from itertools import pairwise
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.physics.geometry import (
    VISIBLE_GROUPS,
    read_geoms,
    resolve_rgba,
    shown_geoms,
)
from pixelbrax_jax.physics.lighting import checker, mean_color, read_look
from pixelbrax_jax.physics.opengl import mujoco
from pixelbrax_jax.physics.viewpoints import read_rigs
from pixelbrax_jax.physics.viewpoints import tracked_body as tracked_body
from pixelbrax_jax.types import CameraRig, GeomKind, Geoms, Look, String
from pixelbrax_jax.validation import check_choice

COM_LINK = "camera/com"
TARGET_LINK = "target"

_PIECES = 6
"""Capsules of a string that hangs."""

_SITE = int(mujoco.mjtWrap.mjWRAP_SITE)
_JOINT = int(mujoco.mjtWrap.mjWRAP_JOINT)


class ModelScene(NamedTuple):
    """What there is to draw, and from where.

    Attributes:
        geoms: geoms, visible sites (``site/<name>``) and the pieces of visible tendons
            (``tendon/<name>/<piece>``).
        rig: the chosen camera.
        rigs: all cameras that can be rigs, by name.
        look: the model's own lights, sky and ground.
        links: names of links after those of the bodies: ``camera/com``, at the center of mass of
            the subtree of ``tracked_body(model)``, if there is such a body; then ``target``, if
            anything movable is visible. Neither turns.
    """

    geoms: Geoms
    rig: CameraRig
    rigs: dict[str, CameraRig]
    look: Look
    links: tuple[str, ...]


def read_scene(
    model: mujoco.MjModel, camera: int | str = 0, *, movable: Collection[str] = ()
) -> ModelScene:
    """Read what MuJoCo's own renderer would show of a model by default.

    Args:
        model: a compiled model; link i is its body i + 1.
        camera: name of a camera, or index in the model.
        movable: names of geoms, sites and lamps of the world that move together, with the link
            ``target``; the first visible geom or site is at that link's origin.

    Returns:
        The scene's parts.

    Raises:
        ValueError: there is no such camera, or its orientation follows a body; a name of
            ``movable`` is unknown or not of the world; something visible cannot be drawn.
    """
    _check_movable(model, movable)
    links = [COM_LINK] if tracked_body(model) >= 0 else []
    geoms = _with_strings(model, with_sites(model, _with_planes(model)))
    target = model.nbody - 1 + len(links)
    moved = [g for g, name in enumerate(geoms.name) if name.removeprefix("site/") in movable]
    anchor = np.zeros(3)
    if moved:
        links.append(TARGET_LINK)
        anchor = np.asarray(geoms.pos[moved[0]])
        geoms = geoms.replace(
            link=tuple(target if g in moved else link for g, link in enumerate(geoms.link)),
            pos=geoms.pos.at[np.array(moved)].add(-anchor),
        )
    com_link = model.nbody - 1 if COM_LINK in links else -1
    rigs = read_rigs(model, com_link)
    look = read_look(
        model,
        com_link=com_link,
        movable=movable,
        target_link=target if moved else -1,
        anchor=anchor,
    )
    return ModelScene(geoms, rigs[_camera_name(model, camera, rigs)], rigs, look, tuple(links))


def _camera_name(model: mujoco.MjModel, camera: int | str, rigs: dict[str, CameraRig]) -> str:
    if isinstance(camera, str):
        return check_choice("camera", camera, rigs)
    if not 0 <= camera < model.ncam:
        raise ValueError(f"the model has no camera {camera}; it has {model.ncam}.")
    return check_choice("camera", model.camera(camera).name or f"camera/{camera}", rigs)


def _check_movable(model: mujoco.MjModel, movable: Collection[str]) -> None:
    bodies: dict[str, int] = {}
    for count, of, body in (
        (model.ngeom, model.geom, model.geom_bodyid),
        (model.nsite, model.site, model.site_bodyid),
        (model.nlight, model.light, model.light_bodyid),
    ):
        bodies |= {of(i).name: int(body[i]) for i in range(count) if of(i).name}
    for name in movable:
        check_choice("geom, site or light", name, bodies)
        if bodies[name] != 0:
            raise ValueError(f"{name!r} cannot be movable: it is fixed to a body that moves.")


def _with_planes(model: mujoco.MjModel) -> Geoms:
    """Return the geoms, with bounds of planes and whether they are checkered.

    Any other texture, and that of another shape, becomes its mean color.
    """
    geoms = read_geoms(model)
    rows = shown_geoms(model)
    means = {name: mean_color(model, i) for name, i in zip(geoms.name, rows, strict=True)}
    geoms = read_geoms(model, colors={name: mean for name, mean in means.items() if mean})
    first = [geoms.material.index(m) for m in range(len(geoms.rgb))]
    return geoms.replace(
        material_name=tuple(_material(model, model.geom_matid[rows[g]]) for g in first),
        bounded=tuple(
            bool(model.geom_type[i] == GeomKind.PLANE and (model.geom_size[i, :2] > 0).any())
            for i in rows
        ),
        patterned=tuple(
            model.geom_type[i] == GeomKind.PLANE and checker(model, i) is not None for i in rows
        ),
    )


def with_sites(
    model: mujoco.MjModel, geoms: Geoms, groups: Collection[int] = VISIBLE_GROUPS
) -> Geoms:
    """Return the geoms with the sites that MuJoCo's viewer would show, as ``site/<name>``.

    Args:
        model: the compiled model.
        geoms: its geoms.
        groups: MuJoCo's groups of sites that are visible.
    """
    rows = []
    for i in range(model.nsite):
        rgba = resolve_rgba(model, model.site_rgba[i], model.site_matid[i])
        if model.site_group[i] not in groups or not rgba[3] > 0:
            continue
        kind = GeomKind(int(model.site_type[i]))
        size = np.array(model.site_size[i], np.float32)
        size[kind.num_sizes :] = 0
        rows.append(
            _Row(
                kind=int(kind),
                link=int(model.site_bodyid[i]) - 1,
                name=f"site/{model.site(i).name or i}",
                size=size,
                pos=model.site_pos[i],
                quat=model.site_quat[i],
                rgb=rgba[:3],
                material=_material(model, model.site_matid[i]),
            )
        )
    return _append(geoms, rows)


def _with_strings(model: mujoco.MjModel, geoms: Geoms) -> Geoms:
    """Return the geoms with those of spatial tendons."""
    strings = []
    for tendon in range(model.ntendon):
        rgba = resolve_rgba(model, model.tendon_rgba[tendon], model.tendon_matid[tendon])
        first, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
        kinds = model.wrap_type[first : first + count]
        hidden = model.tendon_group[tendon] not in VISIBLE_GROUPS or not rgba[3] > 0
        if hidden or (kinds == _JOINT).any():
            continue
        name = model.tendon(tendon).name or str(tendon)
        if (kinds != _SITE).any():
            raise ValueError(
                f"tendon {name!r} runs over geoms or pulleys, which cannot be drawn; hide it with "
                "alpha 0 or group 3, or lead it over sites alone."
            )
        sites = model.wrap_objid[first : first + count]
        slack = float(model.tendon_range[tendon, 1]) if _hangs(model, tendon) else 0.0
        pieces = 1 if slack == 0.0 else _PIECES
        for k, pair in enumerate(pairwise(sites)):
            start = len(geoms.kind)
            row = _Row(
                kind=int(GeomKind.CAPSULE),
                link=-1,
                name="",
                size=np.array([model.tendon_width[tendon], 0.0, 0.0], np.float32),
                pos=np.zeros(3),
                quat=np.array([1.0, 0.0, 0.0, 0.0]),
                rgb=rgba[:3],
                material=_material(model, model.tendon_matid[tendon]),
            )
            names = [f"tendon/{name}/{k * pieces + piece}" for piece in range(pieces)]
            geoms = _append(geoms, [row._replace(name=piece) for piece in names])
            a, b = (int(model.site_bodyid[site]) - 1 for site in pair)
            strings.append(
                String(
                    geoms=tuple(range(start, start + pieces)),
                    link=(a, b),
                    ends=jnp.asarray(model.site_pos[list(pair)], jnp.float32),
                    length=jnp.float32(slack),
                )
            )
    return geoms.replace(strings=tuple(strings))


def _hangs(model: mujoco.MjModel, tendon: int) -> bool:
    """Return whether MuJoCo lets a tendon hang: a limited one between two sites, without force."""
    acts = (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)) & (
        model.actuator_trnid[:, 0] == tendon
    )
    return bool(
        model.tendon_num[tendon] == 2
        and model.tendon_limited[tendon]
        and model.tendon_range[tendon, 0] == 0.0
        and model.tendon_stiffness[tendon] == 0.0
        and model.tendon_damping[tendon] == 0.0
        and model.opt.gravity.any()
        and not acts.any()
    )


class _Row(NamedTuple):
    """One more geom; fields as in ``Geoms``, and its material's name."""

    kind: int
    link: int
    name: str
    size: np.ndarray
    pos: np.ndarray
    quat: np.ndarray
    rgb: np.ndarray
    material: str


def _material(model: mujoco.MjModel, index: int) -> str:
    """Return a material's name, empty for none."""
    return str(model.material(index).name) if index >= 0 else ""


def _append(geoms: Geoms, rows: list[_Row]) -> Geoms:
    """Return the geoms with more; those of a known color share its material."""
    if not rows:
        return geoms
    rgb, names = [np.asarray(color) for color in geoms.rgb], list(geoms.material_name)
    of_planes = {
        m for m, kind in zip(geoms.material, geoms.kind, strict=True) if kind == GeomKind.PLANE
    }
    materials = []
    for row in rows:
        color = np.asarray(row.rgb, np.float32)
        same = [m for m, c in enumerate(rgb) if m not in of_planes and (c == color).all()]
        if not same:
            rgb.append(color)
            names.append(row.material)
        materials.append(same[0] if same else len(rgb) - 1)

    def stack(old: object, name: str) -> object:
        new = np.stack([getattr(row, name) for row in rows]).astype(np.float32)
        return jnp.concatenate([jnp.asarray(old), new])

    none = (False,) * len(rows)
    return geoms.replace(
        kind=geoms.kind + tuple(row.kind for row in rows),
        link=geoms.link + tuple(row.link for row in rows),
        material=geoms.material + tuple(materials),
        name=geoms.name + tuple(row.name for row in rows),
        size=stack(geoms.size, "size"),
        pos=stack(geoms.pos, "pos"),
        quat=stack(geoms.quat, "quat"),
        rgb=jnp.asarray(np.stack(rgb)),
        material_name=tuple(names) if geoms.material_name else (),
        bounded=geoms.bounded + none if geoms.bounded else (),
        patterned=geoms.patterned + none if geoms.patterned else (),
    )
