"""Looks: PixelBrax's ``default``, the paper's ``original``, DM Control's ``dmc``, a plainer one."""

from __future__ import annotations

from typing import Any

import numpy as np

from pixelbrax_jax.spatial import f32
from pixelbrax_jax.types import Lamp, Look
from pixelbrax_jax.validation import (
    check_array,
    check_arrays,
    check_bool,
    check_choice,
    check_count,
    check_link,
    check_positive,
    check_positive_int,
)

LOOKS: dict[str, Look] = {
    # Cool ground and sky, so that the warm colors of the models stand out.
    "default": Look(
        ground="checker",
        shadows=False,
        shininess=16,
        light=f32([-0.35, -0.55, 1.0]),
        ambient=f32(0.6),
        diffuse=f32(0.8),
        specular=f32(0.0),
        highlight=f32(0.25),
        sky=f32([[0.86, 0.91, 0.97], [0.35, 0.55, 0.82]]),
        ground_rgb=f32([[0.58, 0.62, 0.66], [0.42, 0.46, 0.51]]),
        ground_pitch=f32(0.5),
    ),
    # Light, coefficients and colors of the original renderer (arXiv 2502.00021): white
    # background, thin grid of pitch 2000/2048 m, a light so bright that the ground is white.
    "original": Look(
        ground="grid",
        shadows=False,
        shininess=2,
        light=f32([0.577, -0.577, 0.577]),
        ambient=f32(0.8),
        diffuse=f32(0.8),
        specular=f32(0.6),
        highlight=f32(0.0),
        sky=f32([[1.0, 1.0, 1.0]] * 2),
        ground_rgb=f32([[200 / 255] * 3, [0.0] * 3]),
        ground_pitch=f32(2000 / 2048),
    ),
    # Headlight, checker and sky of the DM Control Suite (common/visual.xml, materials.xml,
    # skybox.xml), and its models' light from above. MuJoCo's tasks have a variant of this look
    # with the lights of their models and, but for `dmc-plain`, all that MuJoCo's renderer draws.
    "dmc": Look(
        ground="checker",
        shadows=True,
        shininess=16,
        light=f32([0.0, 0.0, 1.0]),
        ambient=f32(0.4),
        diffuse=f32(0.6),
        specular=f32(0.0),
        highlight=f32(0.15),
        sky=f32([[0.20, 0.31, 0.40], [0.39, 0.58, 0.77], [0.03, 0.04, 0.05]]),
        ground_rgb=f32([[0.1, 0.2, 0.3], [0.2, 0.3, 0.4]]),
        ground_pitch=f32(1.0),
        headlight=f32(0.8),
    ),
}
LOOKS["dmc-plain"] = LOOKS["dmc"]


_SHAPES: dict[str, tuple[tuple[int, ...], ...]] = {
    **dict.fromkeys(("ambient", "diffuse", "specular", "highlight", "ground_pitch"), ((),)),
    **dict.fromkeys(("headlight", "headlight_highlight", "reflectance", "ground_mark"), ((),)),
    "light": ((3,),),
    "sky": ((2, 3), (3, 3)),
    "ground_rgb": ((2, 3),),
}
_LAMP_SHAPES = {"pos": (3,), "axis": (3,), "cos_cutoff": (), "diffuse": (), "highlight": ()}
_MAY_LACK = ("light", "headlight", "headlight_highlight", "reflectance", "ground_mark")
"""Parts of a look that may be None."""


def make_look(look: str | Look = "default", *, shadows: bool | None = None) -> Look:
    """Return a look by name, or the given one; ``shadows`` other than None replaces its value.

    Raises:
        ValueError: the name is unknown, or a part of the given look has a wrong value.
        TypeError: ``look`` is neither a string nor a ``Look``, or its ``shadows`` are not a bool.
    """
    if isinstance(look, str):
        look = LOOKS[check_choice("look", look, LOOKS)]
    elif not isinstance(look, Look):
        raise TypeError(f"look must be a name or a pixelbrax_jax.Look, got {type(look).__name__}.")
    else:
        look = _checked(look)
    return look if shadows is None else look.replace(shadows=check_bool("shadows", shadows))


def _checked(look: Look) -> Look:
    """Return a look of arrays; raise a ValueError or TypeError that names what is wrong."""
    check_choice("ground of a Look", look.ground, ("checker", "grid"))
    check_positive_int("shininess of a Look", look.shininess)
    check_bool("shadows of a Look", look.shadows)
    check_bool("opengl of a Look", look.opengl)
    shapes = dict(_SHAPES)
    if look.sky_texture is not None:
        edge = (*np.shape(look.sky_texture), 0, 0)[1]
        shapes["sky_texture"] = ((6, edge, edge, 3),)
    parts: dict[str, Any] = {
        name: check_array(f"{name} of a Look", value, *shapes[name])
        for name in shapes
        if (value := getattr(look, name)) is not None or name not in _MAY_LACK
    }
    check_positive("ground_pitch of a Look", parts["ground_pitch"].item())
    if "light" in parts and not parts["light"].any():
        raise ValueError("light of a Look must not have length 0; None is for no such light.")
    if not isinstance(look.lamps, tuple | list):
        raise TypeError(f"lamps of a Look must be a tuple of Lamp, got {look.lamps!r}.")
    return look.replace(**parts, lamps=tuple(map(_checked_lamp, look.lamps)))


def _checked_lamp(lamp: Lamp) -> Lamp:
    if not isinstance(lamp, Lamp):
        raise TypeError(f"lamps of a Look must be a tuple of Lamp, got {lamp!r} in it.")
    check_count("exponent of a Lamp", lamp.exponent)
    check_link("link of a Lamp", lamp.link)
    return lamp.replace(**check_arrays("a Lamp", lamp, _LAMP_SHAPES))
