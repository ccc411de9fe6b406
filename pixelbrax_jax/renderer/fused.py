"""The fast renderer for any block of pixels; `docs/renderer.md` explains it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax import spatial
from pixelbrax_jax._platform.by_platform import computed_once
from pixelbrax_jax.renderer import opengl, shading
from pixelbrax_jax.renderer.intersect import (
    Hit,
    Vector,
    at_least,
    at_most,
    between,
    dot,
)
from pixelbrax_jax.renderer.mirror import reflection
from pixelbrax_jax.renderer.reference import pixel_rays
from pixelbrax_jax.renderer.shading import SHADOW_BIAS
from pixelbrax_jax.renderer.view import (
    Solid,
    View,
    rays,
    solid_of,
    surface_colors,
    vector,
    view_of,
)
from pixelbrax_jax.types import FAR, Camera, Frame, GeomKind, Look, Scene

_INF_BITS = np.uint32(0x7F800000)


def sky_of(
    scene: Scene, height: int, width: int, first_row: jax.Array | int, num_rows: int
) -> list[jax.Array]:
    """Return what the sky's texture adds to each channel of a band's pixels; [] without one.

    It depends on the camera's direction alone: a batch whose cameras do not turn computes it once.
    """
    if scene.look.sky_texture is None:
        return []
    xmat = scene.camera.xmat if scene.sky_xmat is None else scene.sky_xmat

    def look_up(texture: jax.Array, camera: Camera, first_row: jax.Array) -> jax.Array:
        ways = pixel_rays(camera, height, width, first_row + jnp.arange(num_rows)).reshape(-1, 3)
        return shading.sky_texture(texture, *ways.T)

    # XLA would else look texels up in the loop over pixels, slowly, and for each image of a batch.
    # The position is 0, because positions in a batch may differ when directions do not.
    camera = scene.camera.replace(pos=jnp.zeros(3), xmat=xmat)
    given = scene.look.sky_texture, camera, jnp.asarray(first_row)
    like = jax.ShapeDtypeStruct((num_rows * width, 3), jnp.float32)
    added = computed_once(look_up, given, like)
    return [added[:, c] for c in range(3)]


def ground_light_of(
    scene: Scene, height: int, width: int, first_row: jax.Array | int, num_rows: int
) -> dict[int, list[jax.Array]]:
    """Return the factors of each bounded ground's colors from light, by OpenGL's formulas.

    They are (num_rows * width,) each, for a band's pixels as if all saw that ground, and depend
    only on the poses of camera, lamps and ground: a batch in which none moves computes them once.
    """
    geoms, look = scene.geoms, scene.look
    grounds = [g for g in range(len(geoms.kind)) if geoms.is_ground(g) and geoms.is_bounded(g)]
    if not look.opengl or not grounds:
        return {}
    if all(geoms.link[g] < 0 for g in grounds):
        # As in the scene, but the same arrays for all of a batch.
        scene = scene.replace(pos=geoms.pos, xmat=spatial.quat_to_mat(geoms.quat))
    view = jax.lax.optimization_barrier(view_of(scene, height))
    ray = _rays(view, height, width, first_row, num_rows)
    return {
        g: shading.computed_apart(partial(_on_ground, view, ray, solid_of(view, g, False)))
        for g in grounds
    }


def _on_ground(view: View, ray: Vector, plane: Solid) -> list[Any]:
    """Return the factors of one ground's colors from light, where rays see it."""
    lights = opengl.lights_of(view.look, (0.0, 0.0, 1.0))
    place = _place(plane, ray, plane.hit(ray, plane.center).t)
    return opengl.on_plane(lights, (0.0, 0.0, 0.0), plane.center, plane.axes, plane.size, place)


Near = Callable[[int, Callable[[Any], Any], Any], Any]
"""``near(g, update, value)`` returns ``update(value)`` if some pixel of a block may see geom ``g``,
and may return ``value`` otherwise."""


def see(
    view: View,
    ray: Vector,
    near: Near | None = None,
    texture: Sequence[jax.Array] = (),
    ground_light: Mapping[int, Sequence[jax.Array]] | None = None,
) -> Frame:
    """Return what pixels with unit rays see; ``near`` may skip geoms that none sees.

    ``texture`` is what the sky's texture adds to their red, green and blue, if it has one, and
    ``ground_light`` what ``ground_light_of`` returns; None computes it here.

    All parts have the shape of the rays' components. ``seg`` is the rank of the visible geom, and
    the number of geoms for the sky. ``depth`` is exact to a relative ``2**(b - 24)``, with b bits
    for a rank.
    """
    look, geoms, shape, count = view.look, view.geoms, ray[0].shape, len(view.order)

    def solid(g: int) -> Solid:
        return solid_of(view, g, in_kernel=near is not None)

    def hit(g: int) -> Hit:
        return solid(g).hit(ray, solid(g).center)

    if near is None:
        # Branches cannot share results.
        solid, hit = cache(solid), cache(hit)

    to_light = None if look.light is None else vector(look.light)
    along = _directions(ray, to_light, bool(look.lamps) or look.opengl)
    # A key is a distance with the rank in its last bits; the smallest one wins.
    bits = np.uint32((1 << count.bit_length()) - 1)
    key = jnp.full(shape, (_INF_BITS & ~bits) | np.uint32(count), jnp.uint32)
    products = [jnp.zeros(shape)] * len(along)

    def nearer(key: jax.Array, rank: int, entry: Hit) -> jax.Array:
        distance = jax.lax.bitcast_convert_type(entry.t, jnp.uint32)
        return jnp.minimum(key, (distance & ~bits) | np.uint32(rank))

    def update(rank: int, best: tuple[Any, list[Any]]) -> tuple[Any, list[Any]]:
        entry = hit(view.order[rank])
        key = nearer(best[0], rank, entry)
        return key, _normal_products(entry, along, key != best[0], best[1])

    for rank, g in enumerate(view.order):
        if near is None:
            key = nearer(key, rank, hit(g))
        else:
            key, products = near(g, partial(update, rank), (key, products))
    t = jax.lax.bitcast_convert_type(key & ~bits, jnp.float32)
    winner = (key & bits).astype(jnp.int32)
    seen = {g: winner == rank for rank, g in enumerate(view.order)}
    if near is None:
        # Only for the nearest geom: XLA on a CPU is faster without dependent selects.
        for g in view.order:
            products = _normal_products(hit(g), along, seen[g], products)
    n_z, n_l, *n_xy = products
    sky = winner == count
    points = tuple(t * component for component in ray)

    color, on_ground = surface_colors(view, winner), jnp.zeros(shape, bool)
    grounds = []
    for g in filter(geoms.is_ground, view.order):
        on_ground |= seen[g]
        fraction = _ground_fraction(view, g, ray, hit(g).t, solid(g))
        if look.opengl and geoms.is_bounded(g):
            shown = _on_ground(view, ray, solid(g)) if ground_light is None else ground_light[g]
            grounds.append((seen[g], shown))
        for c in range(3):
            first, second = look.ground_rgb[0, c], look.ground_rgb[1, c]
            color[c] = jnp.where(seen[g], first + fraction * (second - first), color[c])

    def ways(ray: Vector, start: Vector) -> Iterator[tuple[jax.Array, jax.Array]]:
        for g in view.order:
            if look.shadows and geoms.kind[g] != GeomKind.PLANE:
                there = tuple(c - p for c, p in zip(solid(g).center, start, strict=True))
                yield seen[g], solid(g).hit(ray, there).t

    normal, light = (*n_xy, n_z), _phong_light
    matte = on_ground
    if look.opengl:
        light = _opengl_light
        for g in view.order:
            if geoms.textured and geoms.textured[g]:
                matte |= seen[g]
    surface = _Surface(ray, points, normal, to_light, n_l, on_ground, matte, grounds)
    shade, highlight = light(look, surface, ways)

    rise = dot(ray, vector(view.up))
    reflected: list[jax.Array] = []
    if view.mirrored is not None:
        way = hit(geoms.mirror).t
        image = partial(reflection, view, ray, way, in_kernel=near is not None)
        found = shading.computed_apart(image) if near is None else image()
        reflected = [jnp.where(seen[geoms.mirror], channel, 0.0) for channel in found]

    def front(c: int) -> jax.Array:
        own = color[c] * shade + highlight
        return between(0.0, own + reflected[c] if reflected else own, 1.0)

    def behind(c: int) -> jax.Array:
        plain = shading.sky(look, rise, c)
        return between(0.0, plain + texture[c], 1.0) if texture else plain

    red, green, blue = (jnp.where(sky, behind(c), front(c)) for c in range(3))
    depth = jnp.where(sky, FAR, -t * ray[2])
    return Frame(r=red, g=green, b=blue, depth=depth, seg=winner, ground=on_ground)


@partial(jax.jit, static_argnames=("height", "width", "num_rows"), inline=True)
def render(
    scene: Scene, height: int, width: int, first_row: jax.Array | int, num_rows: int
) -> Frame:
    """Return a band of rows of an image of the scene; see ``base.render``."""
    # The barrier keeps these numbers out of the loop over pixels.
    view = jax.lax.optimization_barrier(view_of(scene, height))
    ray = _rays(view, height, width, first_row, num_rows)
    texture = sky_of(scene, height, width, first_row, num_rows)
    ground_light = ground_light_of(scene, height, width, first_row, num_rows)
    frame = see(view, ray, texture=texture, ground_light=ground_light)
    frame = frame.replace(seg=jnp.array([*view.order, -1], jnp.int32)[frame.seg])
    return jax.tree.map(lambda plane: plane.reshape(num_rows, width), frame)


def _rays(view: View, height: int, width: int, first_row: jax.Array | int, num_rows: int) -> Vector:
    # All rows in one axis, because separate rows would end in pixels that do not fill a vector.
    index = jnp.arange(num_rows * width, dtype=jnp.int32)
    row = jax.lax.div(index, np.int32(width)) + first_row
    return rays(view, height, width, row, jax.lax.rem(index, np.int32(width)))


def _directions(ray: Vector, to_light: Vector | None, lamps: bool) -> list[tuple[Vector, Any]]:
    """Return vectors whose products with normals are needed, each with its product with the ray."""
    zero = (0.0, 0.0, 0.0)
    along: list[tuple[Vector, Any]] = [((0.0, 0.0, 1.0), ray[2])]
    along.append((zero, 0.0) if to_light is None else (to_light, dot(ray, to_light)))
    if lamps:
        along += [((1.0, 0.0, 0.0), ray[0]), ((0.0, 1.0, 0.0), ray[1])]
    return along


def _normal_products(
    hit: Hit, along: list[tuple[Vector, Any]], here: jax.Array, products: list[jax.Array]
) -> list[jax.Array]:
    """Return products of the outer normal, those of ``hit`` where ``here`` is set."""
    return [
        jnp.where(here, hit.normal_dot(v, ray_v), product)
        for (v, ray_v), product in zip(along, products, strict=True)
    ]


class _Surface(NamedTuple):
    """What pixels see: rays, points, normals, their products with the light, ground and textures.

    ``normal`` has x and y only with lamps or ``Look.opengl``. With the latter, ``grounds`` has for
    each bounded ground where it is seen, and what lights multiply its colors by.
    """

    ray: Vector
    points: Vector
    normal: Vector
    to_light: Vector | None
    n_l: jax.Array
    on_ground: jax.Array
    matte: jax.Array
    grounds: list[tuple[jax.Array, Sequence[jax.Array]]]


Ways = Callable[[Vector, Vector], Iterator[tuple[jax.Array, jax.Array]]]
"""``ways(ray, start)`` yields where each geom that casts shadows is seen, and its distance."""


def _phong_light(look: Look, surface: _Surface, ways: Ways) -> tuple[Any, Any]:
    """Return the factor of colors and what is added to them; see ``Look``."""
    _, points, normal, to_light, n_l, on_ground, *_ = surface
    n_z, shape = normal[-1], n_l.shape
    shade: jax.Array = look.ambient
    highlight: jax.Array | float = 0.0
    if look.headlight is not None:
        shade += look.headlight * at_least(n_z, 0.0)
        shade = jnp.where(on_ground, at_most(shade, 1.0), shade)
    if to_light is not None:
        lit = jnp.ones(shape, bool)
        for here, way in ways(to_light, points):
            # A convex geom casts no shadow on its side that faces the light.
            lit &= ~((way > SHADOW_BIAS) & ~here)
        gloss = shading.gloss(n_l, n_z, to_light[2], look.shininess)
        gloss = jnp.where(lit & (n_l > 0.0), gloss, 0.0)
        diffuse = jnp.where(lit, at_least(n_l, 0.0), 0.0)
        shade = shade + look.diffuse * diffuse + look.specular * gloss
        highlight = look.highlight * gloss
    for lamp in look.lamps:
        pos = vector(lamp.pos)
        beam, inv_distance, strength = shading.beam(lamp, pos, vector(lamp.axis), points)
        to_lamp = tuple(-component for component in beam)
        n_lamp = dot(normal, to_lamp)
        strength = jnp.where(n_lamp > 0.0, strength, 0.0)
        for here, way in ways(beam, pos):
            blocked = (way > 0.0) & ((way + SHADOW_BIAS) * inv_distance < 1.0)
            strength = jnp.where(blocked & ~here, 0.0, strength)
        shine = shading.gloss(n_lamp, n_z, to_lamp[2], look.shininess)
        shade = shade + strength * lamp.diffuse * n_lamp
        highlight = highlight + strength * lamp.highlight * shine
    if look.headlight is not None:
        # A texture dims the highlight too.
        shade = shade + jnp.where(on_ground, highlight, 0.0)
        highlight = jnp.where(on_ground, 0.0, highlight)
    return shade, highlight


def _opengl_light(look: Look, surface: _Surface, ways: Ways) -> tuple[Any, Any]:
    """Return the same with OpenGL's formulas; see ``opengl.py``."""
    ray, points, normal, to_light, _, on_ground, matte, grounds = surface
    lights = opengl.lights_of(look, (0.0, 0.0, 1.0))
    factors = [light(ray, points, normal) for light in lights]
    textures = [opengl.on_texture(pair) for pair in factors]
    for here, found in grounds:
        textures = [jnp.where(here, *pair) for pair in zip(found, textures, strict=True)]
    lit: list[Any] = [True] * len(lights)
    if to_light is not None:
        for here, way in ways(to_light, points):
            lit[1] &= ~((way > SHADOW_BIAS) & ~here)
    for k, lamp in enumerate(look.lamps, len(lights) - len(look.lamps)):
        pos = vector(lamp.pos)
        beam, inv_distance, _ = shading.beam(lamp, pos, vector(lamp.axis), points)
        for here, way in ways(beam, pos):
            blocked = (way > 0.0) & ((way + SHADOW_BIAS) * inv_distance < 1.0)
            lit[k] &= ~(blocked & ~here)
    shade: Any = 0.0
    highlight: Any = 0.0
    for (factor, shine), texture, shown in zip(factors, textures, lit, strict=True):
        shade += jnp.where(shown, jnp.where(on_ground, texture, factor), 0.0)
        highlight += jnp.where(shown & ~matte, shine, 0.0)
    return shade, highlight


def _place(plane: Solid, ray: Vector, t: jax.Array) -> Vector:
    """Return places along a plane's x and y, metres, seen at distances ``t`` along rays."""
    return tuple(t * dot(ray, axis) - dot(plane.center, axis) for axis in plane.axes[:2])


def _ground_fraction(view: View, g: int, ray: Vector, t: jax.Array, plane: Solid) -> jax.Array:
    """Return the second color's fraction on plane ``g``."""
    normal = plane.axes[2]
    slope = 1.0 / at_most(dot(ray, normal), -1e-7)
    inv_pitch = 1.0 / view.look.ground_pitch
    step = -t * ray[2] * view.pixel * inv_pitch
    coords, widths, across, upward = [], [], [], []
    for number, along in enumerate(_place(plane, ray, t)):
        axis, half = plane.axes[number], plane.size[number]
        ray_axis = dot(ray, axis)
        if view.geoms.is_bounded(g):
            # MuJoCo's textures start at the corner of least x and largest y.
            along = along + half if number == 0 else half - along
        coords.append(along * inv_pitch)
        # Derivatives of the coordinate by one pixel to the right and one up.
        right = axis[0] - ray_axis * slope * normal[0]
        above = axis[1] - ray_axis * slope * normal[1]
        widths.append(step * (jnp.abs(right) + jnp.abs(above)))
        across.append(right)
        upward.append(above)
    if view.look.opengl:
        widths = [step * opengl.footprint(across, upward)] * 2
    return shading.second_color_fraction(view.look, *coords, *widths)
