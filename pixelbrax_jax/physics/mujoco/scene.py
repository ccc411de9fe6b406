"""Shapes, cameras and lights of a MuJoCo model."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from itertools import pairwise
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.physics.mujoco.geometry import (
    DEFAULT_RGBA,
    VISIBLE_GROUPS,
    Shape,
    as_geoms,
    geom_shapes,
    hull_errors,
    material_name,
    resolve_rgba,
    site_shapes,
)
from pixelbrax_jax.physics.mujoco.lighting import (
    mean_color,
    mirror_of,
    read_lamps,
    read_look,
    shows_ground,
    texture_of,
)
from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.physics.mujoco.viewpoints import camera_name, read_rigs
from pixelbrax_jax.physics.mujoco.viewpoints import tracked_body as tracked_body
from pixelbrax_jax.physics.task import Color
from pixelbrax_jax.spatial import f32
from pixelbrax_jax.types import CameraRig, GeomKind, Geoms, Look, String

COM_LINK = "camera/com"
TARGET_LINK = "target"

_PIECES = 6
"""Capsules of a hanging string."""

_SITE = int(mujoco.mjtWrap.mjWRAP_SITE)
_SOLIMP = (1e-4, 1e-4, 1e-15, 1e-4, 1.0), (1 - 1e-4, 1 - 1e-4, np.inf, 1 - 1e-4, np.inf)
"""Range to which MuJoCo clips a limit's ``solimp``."""
_JOINT = int(mujoco.mjtWrap.mjWRAP_JOINT)


class ModelScene(NamedTuple):
    """What to render, and from where.

    ``geoms`` also has visible sites (``site/<name>``) and the pieces of visible tendons
    (``tendon/<name>/<piece>``). ``links`` names the links that follow those of the bodies, if any:
    ``camera/com`` at the center of mass of the subtree of ``tracked_body(model)``, and ``target``
    for movable visible elements. Neither turns. ``rig`` is the chosen one of ``rigs``; for
    ``unfit_cameras`` and ``hull_errors`` see ``Physics``.
    """

    geoms: Geoms
    rig: CameraRig | None
    rigs: dict[str, CameraRig]
    unfit_cameras: dict[str, str]
    look: Look
    links: tuple[str, ...]
    hull_errors: dict[str, float]


def read_scene(
    model: mujoco.MjModel,
    camera: int | None = 0,
    *,
    movable: Collection[str] = (),
    colors: Mapping[str, Color] | None = None,
    geom_groups: Collection[int] = VISIBLE_GROUPS,
) -> ModelScene:
    """Read what MuJoCo's renderer shows of a model by default.

    Link i is body i + 1. ``camera`` is the index of one that can be a rig, or None. Geoms, sites
    and lamps of the world that ``movable`` names move together with the link ``target``, whose
    origin is the first visible geom or site. ``colors`` replaces colors of geoms by name; geoms and
    sites are visible in ``geom_groups``. A ValueError names something visible that cannot be
    rendered.
    """
    links = [COM_LINK] if tracked_body(model) >= 0 else []
    com_link = model.nbody - 1 if links else -1
    target = model.nbody - 1 + len(links)
    geoms_seen = list(_textured_geoms(model, colors or {}, geom_groups))
    shapes, lamps = [*geoms_seen, *site_shapes(model, geom_groups)], read_lamps(model, com_link)
    moving = [i for i, s in enumerate(shapes) if s.name.removeprefix("site/") in movable]
    if moving:
        links.append(TARGET_LINK)
        anchor = f32(shapes[moving[0]].pos)
        for i in moving:
            shapes[i] = shapes[i]._replace(link=target, pos=f32(shapes[i].pos) - anchor)
        for name in set(movable) & set(lamps):
            lamps[name] = lamps[name].replace(link=target, pos=lamps[name].pos - anchor)
    pieces, strings = _strings(model, len(shapes))
    mirrors = [i for i, shape in enumerate(geoms_seen) if shape.row == mirror_of(model)]
    geoms = as_geoms([*shapes, *pieces]).replace(
        strings=tuple(strings), mirror=mirrors[0] if mirrors else -1
    )
    rigs, unfit = read_rigs(model, com_link)
    look = read_look(model).replace(lamps=tuple(lamps.values()))
    rig = None if camera is None or not model.ncam else rigs[camera_name(model, camera)]
    return ModelScene(geoms, rig, rigs, unfit, look, tuple(links), hull_errors(shapes))


def _textured_geoms(
    model: mujoco.MjModel, colors: Mapping[str, Color], groups: Collection[int]
) -> Iterator[Shape]:
    """Yield the geoms with finite planes and checkers; other textures become their mean color."""
    for shape in geom_shapes(model, colors=colors, geom_groups=groups):
        is_plane, is_own = shape.kind == GeomKind.PLANE, shape.name in colors
        yield shape._replace(
            rgb=shape.rgb if is_own else mean_color(model, shape.row, shape.rgb),
            bounded=bool(is_plane and (shape.size[:2] > 0).any()),
            patterned=is_plane and not is_own and shows_ground(model, shape.row),
            textured=not is_own and texture_of(model, shape.row) >= 0,
        )


def _strings(model: mujoco.MjModel, first_geom: int) -> tuple[list[Shape], list[String]]:
    """Return spatial tendons and their pieces, which are geoms from ``first_geom`` on."""
    shapes: list[Shape] = []
    strings: list[String] = []
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
                f"tendon {name!r} runs over geoms or pulleys, which cannot be rendered; hide it "
                "with alpha 0 or group 3, or route it only over sites."
            )
        sites = model.wrap_objid[first : first + count]
        slack = float(model.tendon_range[tendon, 1]) if _hangs(model, tendon) else 0.0
        limit = _limit(model, tendon)
        pieces = 1 if slack == 0.0 else _PIECES
        for k, pair in enumerate(pairwise(sites)):
            start = first_geom + len(shapes)
            shapes += [
                Shape(
                    kind=GeomKind.CAPSULE,
                    link=-1,
                    name=f"tendon/{name}/{k * pieces + piece}",
                    size=np.array([model.tendon_width[tendon], 0.0, 0.0], np.float32),
                    pos=np.zeros(3),
                    quat=np.array([1.0, 0.0, 0.0, 0.0]),
                    rgb=tuple(rgba[:3]),
                    material=material_name(model, model.tendon_matid[tendon]),
                    owner=name if limit else "",
                )
                for piece in range(pieces)
            ]
            a, b = (int(model.site_bodyid[site]) - 1 for site in pair)
            strings.append(
                String(
                    geoms=tuple(range(start, start + pieces)),
                    link=(a, b),
                    ends=jnp.asarray(model.site_pos[list(pair)], jnp.float32),
                    length=jnp.float32(slack),
                    **limit,
                )
            )
    return shapes, strings


def _limit(model: mujoco.MjModel, tendon: int) -> dict[str, tuple[float, ...]]:
    """Return the limit that MuJoCo shows, for a tendon without its own color.

    Only for tendons between two sites, whose length is that of the string.
    """
    own = model.tendon_matid[tendon] >= 0 or (model.tendon_rgba[tendon] != DEFAULT_RGBA).any()
    if own or not model.tendon_limited[tendon] or model.tendon_num[tendon] != 2:
        return {}
    margin = float(model.tendon_margin[tendon])
    low, high = map(float, model.tendon_range[tendon])
    solimp = np.clip(model.tendon_solimp_lim[tendon], *_SOLIMP)
    return {
        "limits": (low + margin, high - margin),
        "solimp": tuple(map(float, solimp)),
        "taut_rgb": tuple(map(float, model.vis.rgba.constraint[:3])),
    }


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
