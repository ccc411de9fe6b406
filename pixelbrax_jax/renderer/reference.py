"""The reference renderer, against which others are tested, and which is differentiated.

It is simple on purpose: world frame, one geom after the other, full normals. A missed geom is at
distance ``inf``, and every root and quotient is guarded so that no gradient is NaN.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from pixelbrax_jax import spatial
from pixelbrax_jax.renderer import opengl, shading
from pixelbrax_jax.types import FAR, Camera, Frame, GeomKind, Lamp, Scene


@partial(jax.jit, static_argnames=("height", "width", "num_rows"), inline=True)
def render(
    scene: Scene, height: int, width: int, first_row: jax.Array | int, num_rows: int
) -> Frame:
    """Render a band of rows of an image; see ``base.render``."""
    geoms, look, camera = scene.geoms, scene.look, scene.camera
    rays = pixel_rays(camera, height, width, first_row + jnp.arange(num_rows))
    count = range(len(geoms.kind))
    distances, normals = zip(*(_cast(scene, g, camera.pos, rays) for g in count), strict=True)
    t = jnp.stack(distances)
    nearest = jnp.argmin(t, axis=0)
    t = jnp.min(t, axis=0)
    hit = jnp.isfinite(t)
    t = jnp.where(hit, t, 1.0)
    normal = jnp.take_along_axis(jnp.stack(normals), nearest[None, :, :, None], axis=0)[0]
    points = camera.pos + t[..., None] * rays

    color = jnp.asarray(geoms.rgb)[jnp.array(geoms.material)[nearest]]
    on_ground = hit & jnp.array([geoms.is_ground(g) for g in count])[nearest]
    for g in filter(geoms.is_ground, count):
        tiles = _ground_color(scene, g, rays, height)
        color = jnp.where((nearest == g)[..., None], tiles, color)

    back = camera.xmat[:, 2]
    if look.opengl:
        shade, highlight = _opengl_light(scene, rays, points, normal, nearest, on_ground)
    else:
        shade, highlight = _phong_light(scene, points, normal, nearest, on_ground, back)
    shade, highlight = (jnp.broadcast_to(x, hit.shape)[..., None] for x in (shade, highlight))
    surface = color * shade + highlight
    if look.reflectance is not None and geoms.mirror >= 0:
        here = (hit & (nearest == geoms.mirror))[..., None]
        surface += jnp.where(here, _reflection(scene, rays, t), 0.0)
    surface = jnp.clip(surface, 0.0, 1.0)
    rise = rays[..., 2:]
    sky = look.sky[0] + jnp.clip(rise, 0.0, 1.0) * (look.sky[1] - look.sky[0])
    if look.sky.shape[0] == 3:
        sky += jnp.clip(-rise, 0.0, 1.0) * (look.sky[2] - look.sky[0])
    if look.sky_texture is not None:
        added = shading.sky_texture(look.sky_texture, *rays.reshape(-1, 3).T)
        sky = jnp.clip(sky + added.reshape(rays.shape), 0.0, 1.0)
    rgb = jnp.where(hit[..., None], surface, sky)
    return Frame(
        r=rgb[..., 0],
        g=rgb[..., 1],
        b=rgb[..., 2],
        depth=jnp.where(hit, -t * (rays @ back), FAR),
        seg=jnp.where(hit, nearest, -1).astype(jnp.int32),
        ground=on_ground,
    )


def _phong_light(
    scene: Scene,
    points: jax.Array,
    normal: jax.Array,
    nearest: jax.Array,
    on_ground: jax.Array,
    back: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Return the factor of colors and what is added to them, (H, W) or (); see ``Look``."""
    look = scene.look
    n_z = normal @ back
    shade, highlight = look.ambient, jnp.zeros(())
    if look.headlight is not None:
        shade = shade + look.headlight * jnp.maximum(n_z, 0.0)
        shade = jnp.where(on_ground, jnp.minimum(shade, 1.0), shade)
    if look.light is not None:
        to_light = spatial.unit(look.light)
        n_l = normal @ to_light
        lit = n_l > 0.0
        if look.shadows:
            light_rays = jnp.broadcast_to(to_light, points.shape)
            lit &= ~_shaded(scene, points, light_rays, jnp.inf, nearest)
        gloss = jnp.maximum(2.0 * n_l * n_z - to_light @ back, 0.0) ** look.shininess
        gloss = jnp.where(lit, gloss, 0.0)
        shade = shade + look.diffuse * jnp.where(lit, n_l, 0.0) + look.specular * gloss
        highlight = highlight + look.highlight * gloss
    for lamp in look.lamps:
        more, shine = _lamplight(scene, lamp, points, normal, nearest)
        shade, highlight = shade + more, highlight + shine
    if look.headlight is not None:
        # A texture dims the highlight too.
        shade, highlight = (
            jnp.where(on_ground, shade + highlight, shade),
            jnp.where(on_ground, 0.0, highlight),
        )
    return shade, highlight


def _opengl_light(
    scene: Scene,
    rays: jax.Array,
    points: jax.Array,
    normal: jax.Array,
    nearest: jax.Array,
    on_ground: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Return the same with OpenGL's formulas; see ``opengl.py``."""
    geoms, look, camera = scene.geoms, scene.look, scene.camera
    unlit = look if look.light is None else look.replace(light=spatial.unit(look.light))
    lights = opengl.lights_of(unlit, tuple(camera.xmat[:, 2]))
    ray, point, n = (tuple(jnp.moveaxis(x, -1, 0)) for x in (rays, points, normal))
    factors = [light(ray, point, n) for light in lights]
    textures = [opengl.on_texture(pair) for pair in factors]
    for g in range(len(geoms.kind)):
        if geoms.is_ground(g) and geoms.is_bounded(g):
            pos, axes = scene.pos[g], scene.xmat[g]
            place = tuple(jnp.moveaxis((points - pos) @ axes, -1, 0)[:2])
            size, center = tuple(geoms.size[g]), tuple(pos)
            found = opengl.on_plane(lights, tuple(camera.pos), center, tuple(axes.T), size, place)
            textures = [
                jnp.where(nearest == g, *pair) for pair in zip(found, textures, strict=True)
            ]
    matte = on_ground
    if geoms.textured:
        matte |= jnp.array(geoms.textured)[nearest]
    shade, highlight = jnp.zeros(nearest.shape), jnp.zeros(nearest.shape)
    for k, ((factor, shine), texture) in enumerate(zip(factors, textures, strict=True)):
        lit = jnp.ones(nearest.shape, bool)
        if k and look.shadows:
            lit = ~_in_shadow(scene, k, points, nearest)
        shade += jnp.where(lit, jnp.where(on_ground, texture, factor), 0.0)
        highlight += jnp.where(lit & ~matte, shine, 0.0)
    return shade, highlight


def _in_shadow(scene: Scene, light: int, points: jax.Array, nearest: jax.Array) -> jax.Array:
    """Return where a light of ``opengl.lights_of`` but the first is blocked."""
    look = scene.look
    if look.light is not None and light == 1:
        to_light = jnp.broadcast_to(spatial.unit(look.light), points.shape)
        return _shaded(scene, points, to_light, jnp.inf, nearest)
    lamp = look.lamps[light - 1 - (look.light is not None)]
    away = points - lamp.pos
    ray = spatial.unit(away)
    until = jnp.sum(away * ray, -1) - shading.SHADOW_BIAS
    return _shaded(scene, lamp.pos, ray, until, nearest)


def _reflection(scene: Scene, rays: jax.Array, until: jax.Array) -> jax.Array:
    """Return the color that pixels get from a mirror at ``until``, (H, W, 3); see ``mirror.py``."""
    geoms, look, camera = scene.geoms, scene.look, scene.camera
    reflectance = jnp.asarray(look.reflectance)
    base, axis = scene.pos[geoms.mirror], scene.xmat[geoms.mirror][:, 2]
    eye = camera.pos - 2.0 * ((camera.pos - base) @ axis) * axis
    rays = rays - 2.0 * (rays @ axis)[..., None] * axis
    others = [g for g in range(len(geoms.kind)) if g != geoms.mirror and not geoms.is_ground(g)]
    found = jnp.zeros(rays.shape)
    nearest = jnp.full(until.shape, jnp.inf)
    look = look if look.light is None else look.replace(light=spatial.unit(look.light))
    lights = opengl.lights_of(look, tuple(camera.xmat[:, 2]))
    for g in others:
        t, normal = _cast(scene, g, eye, rays)
        first = (t > until) & (t < nearest)
        points = eye + jnp.where(first, t, 1.0)[..., None] * rays
        ray, point, n = (tuple(jnp.moveaxis(x, -1, 0)) for x in (rays, points, normal))
        factors = [light(ray, point, n) for light in lights]
        shade, highlight = (sum(part) for part in zip(*factors, strict=True))
        if geoms.textured and geoms.textured[g]:
            highlight = 0.0
        shade, highlight = (jnp.broadcast_to(x, t.shape)[..., None] for x in (shade, highlight))
        color = reflectance * jnp.asarray(geoms.rgb)[geoms.material[g]]
        seen = jnp.clip(color * shade + highlight, 0.0, 1.0)
        found = jnp.where(first[..., None], seen, found)
        nearest = jnp.where(first, t, nearest)
    return found


def pixel_rays(camera: Camera, height: int, width: int, rows: jax.Array) -> jax.Array:
    """Return unit rays through the pixels' centers, world frame, (len(rows), W, 3)."""
    pixel = 2.0 * jnp.tan(jnp.deg2rad(camera.fovy) / 2.0) / height
    x = (jnp.arange(width) - 0.5 * (width - 1)) * pixel
    y = (0.5 * (height - 1) - rows) * pixel
    x, y = jnp.meshgrid(x, y)
    return spatial.unit(jnp.stack([x, y, -jnp.ones_like(x)], axis=-1)) @ camera.xmat.T


def _cast(scene: Scene, g: int, origin: jax.Array, rays: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return distances at which rays enter a geom (``inf`` if never), and normals, world frame."""
    geoms, xmat, size = scene.geoms, scene.xmat[g], scene.geoms.size[g]
    if geoms.kind[g] == GeomKind.MESH:
        size = jnp.asarray(geoms.planes)[slice(*geoms.rows_of_planes(g))]
    d = rays @ xmat
    o = jnp.broadcast_to((origin - scene.pos[g]) @ xmat, d.shape)
    t, normal = _LOCAL[GeomKind(geoms.kind[g])](o, d, size)
    if geoms.is_bounded(g):
        half = size[:2]
        inside = jnp.all((jnp.abs(_at(o, d, t)[..., :2]) <= half) | (half <= 0.0), axis=-1)
        t = jnp.where(inside, t, jnp.inf)
    return t, normal @ xmat.T


def _shaded(
    scene: Scene, origin: jax.Array, rays: jax.Array, until: jax.Array | float, nearest: jax.Array
) -> jax.Array:
    """Return whether rays hit another geom than the ``nearest``; planes cast no shadows."""
    shaded = jnp.zeros(nearest.shape, bool)
    for g, kind in enumerate(scene.geoms.kind):
        if kind != GeomKind.PLANE:
            way, _ = _cast(scene, g, origin, rays)
            blocked = jnp.isfinite(way) & (way > shading.SHADOW_BIAS) & (way < until)
            shaded |= blocked & (nearest != g)
    return shaded


def _lamplight(
    scene: Scene, lamp: Lamp, points: jax.Array, normal: jax.Array, nearest: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return what a lamp adds to the factor of colors, and to the colors, (H, W) each."""
    away = points - lamp.pos
    ray = spatial.unit(away)
    along = ray @ lamp.axis
    n_l = -jnp.sum(ray * normal, -1)
    lit = (along >= lamp.cos_cutoff) & (n_l > 0.0)
    if scene.look.shadows:
        until = jnp.sum(away * ray, -1) - shading.SHADOW_BIAS
        lit &= ~_shaded(scene, lamp.pos, ray, until, nearest)
    strength = jnp.where(lit, jnp.maximum(along, 0.0) ** lamp.exponent, 0.0)
    back = scene.camera.xmat[:, 2]
    shine = jnp.maximum(2.0 * n_l * (normal @ back) + ray @ back, 0.0) ** scene.look.shininess
    return strength * lamp.diffuse * n_l, strength * lamp.highlight * shine


def _entry(a: jax.Array, b: jax.Array, c: jax.Array) -> jax.Array:
    """Return the smaller root of ``a t^2 + 2 b t + c`` if it is real and positive, else ``inf``."""
    discriminant = b * b - a * c
    real = (discriminant > 0.0) & (a > 1e-7)
    root = jnp.sqrt(jnp.where(real, discriminant, 1.0))
    t = (-b - root) / jnp.where(real, a, 1.0)
    return jnp.where(real & (t > 0.0), t, jnp.inf)


def _at(o: jax.Array, d: jax.Array, t: jax.Array) -> jax.Array:
    """Return points on the rays; points near the origin where ``t`` is infinite."""
    return o + jnp.where(jnp.isfinite(t), t, 1.0)[..., None] * d


def _plane(o: jax.Array, d: jax.Array, size: jax.Array) -> tuple[jax.Array, jax.Array]:
    del size  # see _cast
    descends = d[..., 2] < -1e-7
    t = -o[..., 2] / jnp.where(descends, d[..., 2], -1.0)
    normal = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), d.shape)
    return jnp.where(descends & (t > 0.0), t, jnp.inf), normal


def _sphere(o: jax.Array, d: jax.Array, size: jax.Array) -> tuple[jax.Array, jax.Array]:
    t = _entry(jnp.sum(d * d, -1), jnp.sum(o * d, -1), jnp.sum(o * o, -1) - size[0] ** 2)
    return t, spatial.unit(_at(o, d, t))


def _side(o: jax.Array, d: jax.Array, size: jax.Array) -> jax.Array:
    """Return distances at which rays enter a cylinder through its side."""
    flat_o, flat_d = o[..., :2], d[..., :2]
    t = _entry(
        jnp.sum(flat_d * flat_d, -1),
        jnp.sum(flat_o * flat_d, -1),
        jnp.sum(flat_o * flat_o, -1) - size[0] ** 2,
    )
    return jnp.where(jnp.abs(_at(o, d, t)[..., 2]) <= size[1], t, jnp.inf)


def _capsule(o: jax.Array, d: jax.Array, size: jax.Array) -> tuple[jax.Array, jax.Array]:
    half = size[1]
    t = _side(o, d, size)
    for end in (-half, half):
        cap, _ = _sphere(o - jnp.array([0.0, 0.0, 1.0]) * end, d, size)
        t = jnp.minimum(t, cap)
    # From inside, a ray would enter the sphere of an end.
    beside = o - jnp.clip(o[..., 2:], -half, half) * jnp.array([0.0, 0.0, 1.0])
    t = jnp.where(jnp.sum(beside * beside, -1) < size[0] ** 2, jnp.inf, t)
    point = _at(o, d, t)
    on_axis = jnp.clip(point[..., 2], -half, half)
    return t, spatial.unit(point - on_axis[..., None] * jnp.array([0.0, 0.0, 1.0]))


def _ellipsoid(o: jax.Array, d: jax.Array, size: jax.Array) -> tuple[jax.Array, jax.Array]:
    so, sd = o / size, d / size
    t = _entry(jnp.sum(sd * sd, -1), jnp.sum(so * sd, -1), jnp.sum(so * so, -1) - 1.0)
    return t, spatial.unit(_at(o, d, t) / size**2)


def _cylinder(o: jax.Array, d: jax.Array, size: jax.Array) -> tuple[jax.Array, jax.Array]:
    radius, half = size[0], size[1]
    side = _side(o, d, size)
    outward = jnp.where(d[..., 2] > 0, -1.0, 1.0)
    slanted = jnp.abs(d[..., 2]) > 1e-7
    cap = (outward * half - o[..., 2]) / jnp.where(slanted, d[..., 2], 1.0)
    flat = _at(o, d, cap)[..., :2]
    inside = jnp.sum(flat * flat, -1) <= radius**2
    cap = jnp.where(slanted & inside & (cap > 0.0), cap, jnp.inf)
    t = jnp.minimum(side, cap)
    point = _at(o, d, t)
    side_normal = spatial.unit(point * jnp.array([1.0, 1.0, 0.0]))
    cap_normal = outward[..., None] * jnp.array([0.0, 0.0, 1.0])
    return t, jnp.where((side <= cap)[..., None], side_normal, cap_normal)


def _box(o: jax.Array, d: jax.Array, size: jax.Array) -> tuple[jax.Array, jax.Array]:
    safe = jnp.where(jnp.abs(d) < 1e-7, 1e-7, d)
    outward = jnp.where(safe > 0, -1.0, 1.0)
    near = (outward * size - o) / safe
    far = (-outward * size - o) / safe
    face = jnp.argmax(near, axis=-1)
    entry, leave = jnp.max(near, axis=-1), jnp.min(far, axis=-1)
    t = jnp.where((entry <= leave) & (entry > 0.0), entry, jnp.inf)
    return t, jax.nn.one_hot(face, 3, dtype=d.dtype) * outward


def _mesh(o: jax.Array, d: jax.Array, planes: jax.Array) -> tuple[jax.Array, jax.Array]:
    normals, offsets = planes[:, :3], planes[:, 3]
    along = d @ normals.T
    safe = jnp.where(jnp.abs(along) < 1e-7, 1e-7, along)
    crossed = (offsets - o @ normals.T) / safe
    entries = jnp.where(safe < 0.0, crossed, -jnp.inf)
    entry = jnp.max(entries, axis=-1)
    leave = jnp.min(jnp.where(safe > 0.0, crossed, jnp.inf), axis=-1)
    t = jnp.where((entry <= leave) & (entry > 0.0), entry, jnp.inf)
    return t, normals[jnp.argmax(entries, axis=-1)]


_LOCAL = {
    GeomKind.PLANE: _plane,
    GeomKind.SPHERE: _sphere,
    GeomKind.CAPSULE: _capsule,
    GeomKind.ELLIPSOID: _ellipsoid,
    GeomKind.CYLINDER: _cylinder,
    GeomKind.BOX: _box,
    GeomKind.MESH: _mesh,
}
assert set(_LOCAL) == set(GeomKind), f"no formulas: {set(GeomKind) - set(_LOCAL)}"


def _ground_color(scene: Scene, g: int, rays: jax.Array, height: int) -> jax.Array:
    """Return the pattern of plane ``g`` where rays hit it, (H, W, 3)."""
    look, camera, pos, xmat = scene.look, scene.camera, scene.pos[g], scene.xmat[g]
    o, d = (camera.pos - pos) @ xmat, rays @ xmat
    pixel = 2.0 * jnp.tan(jnp.deg2rad(camera.fovy) / 2.0) / height
    # Rays of length 1 along the viewing axis are linear in the pixel's position, so their
    # derivatives by one pixel are the camera's axes.
    unit_depth = -1.0 / (rays @ camera.xmat[:, 2])
    d = d * unit_depth[..., None]
    down = jnp.minimum(d[..., 2], -1e-7)
    s = -o[2] / down
    footprint = jnp.zeros((*s.shape, 2))
    steps = []
    for axis in (camera.xmat[:, 0], camera.xmat[:, 1]):
        turn = (axis * pixel) @ xmat
        moved = s[..., None] * (turn[:2] - d[..., :2] * (turn[2] / down)[..., None])
        footprint += jnp.abs(moved)
        steps.append((moved[..., 0], moved[..., 1]))
    if look.opengl:
        footprint = jnp.broadcast_to(opengl.footprint(*steps)[..., None], footprint.shape)
    coords = o[:2] + s[..., None] * d[..., :2]
    if scene.geoms.is_bounded(g):
        # MuJoCo's textures start at the corner of least x and largest y.
        coords = scene.geoms.size[g, :2] + coords * jnp.array([1.0, -1.0])
    coords /= look.ground_pitch
    footprint = footprint / look.ground_pitch
    fraction = shading.second_color_fraction(
        look, coords[..., 0], coords[..., 1], footprint[..., 0], footprint[..., 1]
    )
    first, second = look.ground_rgb[0], look.ground_rgb[1]
    return first + fraction[..., None] * (second - first)
