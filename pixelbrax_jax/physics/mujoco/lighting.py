"""Lights, sky and ground of a MuJoCo model, as a look.

MuJoCo's renderer is OpenGL's fixed pipeline: ambient and diffuse light times a material's color,
and a white highlight.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from pixelbrax_jax.physics.mujoco.opengl import mujoco
from pixelbrax_jax.physics.mujoco.sky import sky_colors, sky_texture, texture_pixels
from pixelbrax_jax.physics.mujoco.viewpoints import follows_tracked
from pixelbrax_jax.physics.task import Color
from pixelbrax_jax.spatial import f32
from pixelbrax_jax.types import Lamp, Look

_DIRECTIONAL = int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
_POINT = int(mujoco.mjtLightType.mjLIGHT_POINT)
_IMAGE = int(mujoco.mjtLightType.mjLIGHT_IMAGE)
_AIMED = (
    int(mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODY),
    int(mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODYCOM),
)
_TRACKCOM = int(mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM)
_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
_RGB = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)

_SPECULAR = 0.5
"""Specular reflection of MuJoCo's default material."""

_EXPONENT = 64
"""Shininess of MuJoCo's default material, 0.5, in OpenGL's units."""

_SHININESS = 16
"""A quarter of that: its exponent is for the half vector between light and viewer, and Phong's
mirrored vector turns twice as fast."""


def read_look(model: mujoco.MjModel) -> Look:
    """Return the look of a model, without its lamps.

    Lights become grey, and the sky's texture becomes its best fit by three colors. Directional
    lights after the first are left out, with a warning.
    """
    suns = [i for i in _active(model) if model.light_type[i] == _DIRECTIONAL]
    if len(suns) > 1:
        warnings.warn(
            f"of {len(suns)} directional lights only the first, "
            f"{model.light(suns[0]).name or suns[0]!r}, is rendered.",
            stacklevel=2,
        )
    _warn_of_lights(model)
    sun = suns[0] if suns else None
    toward = None if sun is None else -_axis(model, sun)
    headlight = model.vis.headlight
    pitch, colors = _ground(model)
    return Look(
        ground="checker",
        shadows=_cast_shadows(model),
        shininess=_SHININESS,
        light=None if toward is None else f32(toward),
        ambient=f32(_ambient(model)),
        diffuse=f32(0.0 if sun is None else model.light_diffuse[sun].mean()),
        specular=f32(0.0),
        highlight=f32(0.0 if sun is None else _SPECULAR * model.light_specular[sun].mean()),
        sky=sky_colors(model),
        ground_rgb=colors,
        ground_pitch=pitch,
        headlight=f32(headlight.diffuse.mean()) if headlight.active else None,
    )


def detailed(model: mujoco.MjModel, look: Look | None, pixel: float) -> Look:
    """Return a look with all that MuJoCo's renderer draws; see ``Physics.detailed_look``."""
    look = read_look(model) if look is None else look
    headlight = model.vis.headlight
    mirror = mirror_of(model)
    shines = bool(headlight.active and headlight.specular.any())
    return look.replace(
        opengl=True,
        shininess=_EXPONENT,
        headlight_highlight=f32(_SPECULAR * headlight.specular.mean()) if shines else None,
        reflectance=f32(model.mat_reflectance[model.geom_matid[mirror]]) if mirror >= 0 else None,
        sky_texture=sky_texture(model, np.asarray(look.sky), pixel),
        ground_mark=_ground_mark(model),
    )


def mirror_of(model: mujoco.MjModel) -> int:
    """Return the index of the plane that reflects in MuJoCo's renderer, the first; -1 for none."""
    for geom in np.flatnonzero(model.geom_type == _PLANE):
        material = int(model.geom_matid[geom])
        if material >= 0 and model.mat_reflectance[material] > 0:
            return int(geom)
    return -1


def read_lamps(model: mujoco.MjModel, com_link: int) -> dict[str, Lamp]:
    """Return the model's lamps by name.

    A lamp follows its body but does not turn. ``com_link`` is the link at the tracked center of
    mass, -1 for none.
    """
    lamps = {}
    for light in map(int, np.flatnonzero(_rendered(model) & (model.light_type != _DIRECTIONAL))):
        mode, body = int(model.light_mode[light]), int(model.light_bodyid[light])
        link, pos = body - 1, model.light_pos0[light]
        if body == 0:
            # It is up to date even if the model was edited after it was compiled.
            pos = model.light_pos[light]
        axis = _axis(model, light)
        if mode == _TRACKCOM:
            link, pos = com_link, model.light_poscom0[light]
        cutoff, exponent = float(model.light_cutoff[light]), float(model.light_exponent[light])
        if model.light_type[light] == _POINT:
            cutoff, exponent = 180.0, 0.0
        lamps[model.light(light).name or f"light/{light}"] = Lamp(
            link=link,
            exponent=round(exponent),
            pos=f32(pos),
            axis=f32(axis),
            cos_cutoff=f32(-1.0 if cutoff >= 180.0 else np.cos(np.deg2rad(cutoff))),
            diffuse=f32(model.light_diffuse[light].mean()),
            highlight=f32(_SPECULAR * model.light_specular[light].mean()),
        )
    return lamps


def _axis(model: mujoco.MjModel, light: int) -> np.ndarray:
    """Return a light's direction; for one that turns to a body, that in the first pose."""
    if int(model.light_mode[light]) in _AIMED:
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        axis: np.ndarray = data.light_xdir[light]
        return axis
    is_fixed = model.light_bodyid[light] == 0
    # These are up to date even if the model was edited after it was compiled.
    return model.light_dir[light] if is_fixed else model.light_dir0[light]


def _cast_shadows(model: mujoco.MjModel) -> bool:
    """Return whether any light casts shadows; true if there is no light."""
    rendered = _rendered(model)
    return not rendered.any() or bool(model.light_castshadow[rendered].any())


def _rendered(model: mujoco.MjModel) -> np.ndarray:
    """Return, for each light, whether it is rendered.

    The first directional light and all lamps are, but no images, and no lamps that follow another
    center of mass than the camera.
    """
    rendered = model.light_active.astype(bool) & (model.light_type != _IMAGE)
    suns = model.light_type == _DIRECTIONAL
    rendered[np.flatnonzero(rendered & suns)[1:]] = False
    for lamp in np.flatnonzero(rendered & ~suns & (model.light_mode == _TRACKCOM)):
        rendered[lamp] = follows_tracked(model, int(model.light_bodyid[lamp]))
    return rendered


def _warn_of_lights(model: mujoco.MjModel) -> None:
    """Warn about features of a model's lights that are not rendered."""
    rendered, modes, kinds = _rendered(model), model.light_mode, model.light_type
    left_out = model.light_active.astype(bool) & ~rendered
    fades = (model.light_attenuation != (1, 0, 0)).any(axis=1) & (kinds != _DIRECTIONAL)
    shadows = model.light_castshadow.astype(bool)
    unlike = {
        "lights do not turn to bodies": rendered & np.isin(modes, _AIMED),
        "attenuation is left out": rendered & fades,
        "casts shadows, because other lights do": rendered & ~shadows & shadows[rendered].any(),
        "lights of images are left out": left_out & (kinds == _IMAGE),
        "left out, because it follows another center of mass than the camera": left_out
        & ~np.isin(kinds, (_DIRECTIONAL, _IMAGE)),
    }
    for what, where in unlike.items():
        names = [repr(model.light(i).name or f"light/{i}") for i in np.flatnonzero(where)]
        if names:
            warnings.warn(f"light {', '.join(names)}: {what}.", stacklevel=4)


def _active(model: mujoco.MjModel) -> list[int]:
    return np.flatnonzero(model.light_active).tolist()


def _ambient(model: mujoco.MjModel) -> float:
    active = _active(model)
    ambient = float(sum((model.light_ambient[i].mean() for i in active), 0.0))
    if model.vis.headlight.active:
        ambient += float(model.vis.headlight.ambient.mean())
    elif not active:
        ambient = 0.3  # MuJoCo's own, where there is no light at all
    return ambient


def checker(model: mujoco.MjModel, geom: int) -> np.ndarray | None:
    """Return the two colors of a geom's checkered texture, (2, 3) in [0, 1]; None for none."""
    texture = texture_of(model, geom)
    if texture < 0 or model.tex_type[texture] != int(mujoco.mjtTexture.mjTEXTURE_2D):
        return None
    pixels = texture_pixels(model, texture)
    # One pixel of each quarter: the first and last have one color, the others another.
    rows, columns = (np.arange(1, 4, 2) * size // 4 for size in pixels.shape[:2])
    (a, b), (c, d) = pixels[np.ix_(rows, columns)]
    if not ((a == d).all() and (b == c).all() and (a != b).any()):
        return None
    return np.stack([a, b]) / 255.0 * model.mat_rgba[model.geom_matid[geom], :3]


def mean_color(model: mujoco.MjModel, geom: int, color: Color) -> Color:
    """Return the mean color of a geom's texture times ``color``; ``color`` for none.

    MuJoCo limits the light on a texture to 1. The color is darkened by the excess of ambient light
    and headlight on a surface that faces the camera.
    """
    texture = texture_of(model, geom)
    if texture < 0:
        return color
    headlight = model.vis.headlight
    light = _ambient(model) + (float(headlight.diffuse.mean()) if headlight.active else 0.0)
    mean = texture_pixels(model, texture).mean((0, 1)) / 255.0 * color
    red, green, blue = mean / max(light, 1.0)
    return float(red), float(green), float(blue)


def texture_of(model: mujoco.MjModel, geom: int) -> int:
    """Return the index of a geom's texture, -1 for none."""
    material = int(model.geom_matid[geom])
    return int(model.mat_texid[material, _RGB]) if material >= 0 else -1


def _ground(model: mujoco.MjModel) -> tuple[Any, Any]:
    """Return pitch and colors of the first checkered plane."""
    if (geom := _checkered(model)) is None:
        return f32(1.0), f32([[0.1, 0.2, 0.3], [0.2, 0.3, 0.4]])
    pitch, other = _pitch(model, geom)
    if not np.isclose(pitch, other):
        warnings.warn(
            f"the tiles of plane {model.geom(geom).name or geom!r} are {pitch:.3g} by {other:.3g} "
            "m; squares of the first are rendered.",
            stacklevel=3,
        )
    return f32(pitch), f32(checker(model, geom))


def _pitch(model: mujoco.MjModel, plane: int) -> np.ndarray:
    """Return the (2,) edges of a checkered plane's tiles in metres, two for each texture."""
    material = int(model.geom_matid[plane])
    size = model.geom_size[plane, :2]
    # Along an axis without end the texture repeats by the metre, whatever `texuniform` says.
    spread = (size > 0) & ~bool(model.mat_texuniform[material])
    if not model.mat_texrepeat[material].all():
        raise ValueError(
            f"material {model.mat(material).name or material!r} of a plane has texrepeat 0, so its "
            "tiles have no size; give another."
        )
    repeat = model.mat_texrepeat[material] / np.where(spread, size, 1.0)
    edges: np.ndarray = 1.0 / repeat
    return edges


def shows_ground(model: mujoco.MjModel, plane: int) -> bool:
    """Return whether a plane has the checkers of the look's ground."""
    own, first = checker(model, plane), _checkered(model)
    if own is None or first is None:
        return False
    same = np.allclose(_pitch(model, plane), _pitch(model, first))
    return bool(same and (own == checker(model, first)).all())


def _ground_mark(model: mujoco.MjModel) -> Any:
    """Return ``Look.ground_mark`` of textures whose outermost texels have the second color."""
    if (geom := _checkered(model)) is None:
        return None
    pixels = texture_pixels(model, texture_of(model, geom))
    rows, columns = pixels.shape[:2]
    second = pixels[rows // 4, 3 * columns // 4]
    edges = pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]
    return f32(2.0 / columns) if all((edge == second).all() for edge in edges) else None


def _checkered(model: mujoco.MjModel) -> int | None:
    planes = map(int, np.flatnonzero(model.geom_type == _PLANE))
    return next((geom for geom in planes if checker(model, geom) is not None), None)
