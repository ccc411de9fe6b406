"""Values that the modules of the package exchange.

Shapes are those of ONE environment; a batch has the same fields with a leading axis. Letters: G
geoms, M materials, L links, S state features, A actions, H and W pixels, K stacked frames. Arrays
are float32 unless stated otherwise. Lengths are metres, angles degrees, quaternions unit ``(w, x,
y, z)``, colors linear in [0, 1]. The world is right-handed with z up. Row 0 of an image is its top.

Fields marked *static* are hashable Python values that decide which program is compiled; they cannot
be traced. All other fields are arrays and may be differentiated, batched or randomised.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import jax
import numpy as np
from flax import struct

FAR = float(np.finfo(np.float32).max)  # metres, the sky; jax_debug_infs forbids infinity


class GeomKind(IntEnum):
    """Shapes that the renderer supports, one row each, starting with MuJoCo's number (``mjtGeom``).

    All but the plane are convex; ``renderer.intersect`` and ``renderer.reference`` have formulas.

    Attributes:
        num_sizes: number of entries of a geom's size that are used.
        reach: radius of the bounding sphere: ``first`` or ``largest`` entry of the size,
            ``diagonal`` (the norm of the size) or ``all`` (infinite).
        is_long: whether the bounding sphere is swept along z by the second entry of the size.
        has_far_form: whether float32 needs a longer formula when the camera is far away.
    """

    num_sizes: int
    reach: str
    is_long: bool
    has_far_form: bool

    def __new__(
        cls,
        number: int,
        num_sizes: int = 0,
        reach: str = "",
        is_long: bool = False,
        has_far_form: bool = False,
    ) -> GeomKind:
        """Make a row."""
        kind = int.__new__(cls, number)
        kind._value_ = number
        kind.num_sizes, kind.reach = num_sizes, reach
        kind.is_long, kind.has_far_form = is_long, has_far_form
        return kind

    PLANE = 0, 3, "all"
    SPHERE = 2, 1, "first", False, True
    CAPSULE = 3, 2, "first", True, True
    ELLIPSOID = 4, 3, "largest"
    CYLINDER = 5, 2, "first", True
    BOX = 6, 3, "diagonal"
    MESH = 7, 1, "first"


class String(struct.PyTreeNode):
    """A string between two points, rendered as a chain of capsules; it sags when it is slack.

    Attributes:
        geoms: static, rows of ``Geoms`` with its capsules, in order. Their link is -1.
        link: (2,) static, indices of the links that hold its ends, -1 for the world.
        ends: (2, 3), its ends in the frames of these links.
        length: (), length of the slack string; ends that are farther apart stretch it.
        limits: (2,) static, lengths beyond which its color turns to ``taut_rgb``, (3,), by the
            impedance of MuJoCo's ``solimp``, (5,); all static. Empty if it never does.
    """

    geoms: tuple[int, ...] = struct.field(pytree_node=False)
    link: tuple[int, int] = struct.field(pytree_node=False)
    ends: jax.Array
    length: jax.Array
    limits: tuple[float, ...] = struct.field(pytree_node=False, default=())
    solimp: tuple[float, ...] = struct.field(pytree_node=False, default=())
    taut_rgb: tuple[float, ...] = struct.field(pytree_node=False, default=())


class Geoms(struct.PyTreeNode):
    """The visible shapes of a task, each fixed in the frame of its link.

    Attributes:
        kind: (G,) static, values of ``GeomKind``.
        link: (G,) static, index of the geom's link, -1 for the world.
        material: (G,) static, row of ``rgb``.
        name: (G,) static, the model's geom name, or ``kind/index`` without one.
        size: (G, 3), MuJoCo's size of each kind: radius, half length, half extents; of a mesh the
            radius of the sphere around its center that contains it.
        pos: (G, 3), in the link's frame.
        quat: (G, 4), in the link's frame.
        rgb: (M, 3), one color per material.
        bounded: (G,) static, planes that end at their size along their x and y; a size of 0 means
            no end. Empty if all planes are infinite.
        patterned: (G,) static, planes that are ground and show the look's pattern; other planes
            show their own color. Empty if all planes are ground.
        textured: (G,) static, geoms whose color is the mean of a texture, which OpenGL dims
            highlights with. Empty if none is.
        mirror: static, index of the plane that reflects, -1 for none; see ``Look.reflectance``.
        distant: static, whether the camera is more than a thousand radii of a sphere or capsule
            away, so that float32 needs the longer formulas of ``renderer.intersect``.
        strings: strings, whose capsules are among the geoms.
        num_planes: (G,) static, number of half-spaces of each mesh, 0 for other kinds. Empty
            without meshes.
        planes: (P, 4), the half-spaces whose intersections are the meshes, those of the first mesh
            first: outer unit normal, and distance from the geom's center, in the geom's frame. They
            must bound the mesh on all sides. None without meshes.
        material_name: (M,) static, the model's material of the first geom of each color. Empty if
            none is known.
    """

    kind: tuple[int, ...] = struct.field(pytree_node=False)
    link: tuple[int, ...] = struct.field(pytree_node=False)
    material: tuple[int, ...] = struct.field(pytree_node=False)
    name: tuple[str, ...] = struct.field(pytree_node=False)
    size: jax.Array
    pos: jax.Array
    quat: jax.Array
    rgb: jax.Array
    bounded: tuple[bool, ...] = struct.field(pytree_node=False, default=())
    patterned: tuple[bool, ...] = struct.field(pytree_node=False, default=())
    textured: tuple[bool, ...] = struct.field(pytree_node=False, default=())
    mirror: int = struct.field(pytree_node=False, default=-1)
    distant: bool = struct.field(pytree_node=False, default=False)
    strings: tuple[String, ...] = ()
    num_planes: tuple[int, ...] = struct.field(pytree_node=False, default=())
    planes: jax.Array | None = None
    material_name: tuple[str, ...] = struct.field(pytree_node=False, default=())

    def is_bounded(self, geom: int) -> bool:
        """Return whether a geom is a finite plane."""
        return bool(self.bounded) and self.bounded[geom]

    def is_ground(self, geom: int) -> bool:
        """Return whether a geom is a plane with the look's pattern."""
        plane = self.kind[geom] == GeomKind.PLANE
        return plane and (not self.patterned or self.patterned[geom])

    def rows_of_planes(self, geom: int) -> tuple[int, int]:
        """Return the first row of a mesh's planes and the row after the last one."""
        if not self.num_planes or self.planes is None:
            raise ValueError(
                f"geom {self.name[geom]!r} is a mesh, and the geoms have no planes: set num_planes "
                "and planes."
            )
        first = sum(self.num_planes[:geom])
        return first, first + self.num_planes[geom]


class PhysicsState(struct.PyTreeNode):
    """Result of a physics step.

    Attributes:
        engine: the engine's own state, opaque to other modules.
        xpos: (L, 3), link origins in the world frame.
        xquat: (L, 4), link orientations in the world frame.
        obs: (S,), the task's state observation.
        reward: (), reward of the last step, 0 after a reset.
        terminated: () bool, the task ended (never a time limit).
        non_finite: () bool, the step diverged; the pose is then the last finite one.
    """

    engine: Any
    xpos: jax.Array
    xquat: jax.Array
    obs: jax.Array
    reward: jax.Array
    terminated: jax.Array
    non_finite: jax.Array


class Camera(struct.PyTreeNode):
    """A pinhole camera in the world frame.

    Attributes:
        pos: (3,).
        xmat: (3, 3), columns are its right, up and back directions, as in MuJoCo and OpenGL; it
            looks along minus the third one.
        fovy: (), vertical field of view.
    """

    pos: jax.Array
    xmat: jax.Array
    fovy: jax.Array


class CameraRig(struct.PyTreeNode):
    """A camera that may follow a link.

    Eye and target are ``offset + track * xpos[link]``; the orientation of the link has no effect.

    Attributes:
        link: static, index of the followed link, -1 for none.
        track: (3,), fraction of the link's position to follow, per world axis.
        eye: (3,).
        target: (3,), the point the camera looks at.
        up: (3,), the world direction that is up in the image.
        fovy: (), vertical field of view.
    """

    link: int = struct.field(pytree_node=False)
    track: jax.Array
    eye: jax.Array
    target: jax.Array
    up: jax.Array
    fovy: jax.Array


class Lamp(struct.PyTreeNode):
    """A spot light that may follow a link.

    It is at ``offset + xpos[link]`` and never turns. It lights a point in direction d (unit length)
    with ``max(d.axis, 0) ** exponent`` of its strength, and with 0 if the angle between d and the
    axis exceeds the cutoff.

    Attributes:
        link: static, index of the followed link, -1 for none.
        exponent: static int, at least 0.
        pos: (3,), the offset; in a scene the position in the world.
        axis: (3,), unit, world direction of its light.
        cos_cutoff: (), cosine of the cutoff angle, -1 for none.
        diffuse, highlight: () coefficients, as in ``Look``.
    """

    link: int = struct.field(pytree_node=False)
    exponent: int = struct.field(pytree_node=False)
    pos: jax.Array
    axis: jax.Array
    cos_cutoff: jax.Array
    diffuse: jax.Array
    highlight: jax.Array


class Look(struct.PyTreeNode):
    """Light, sky and ground.

    A surface of color ``c`` with normal ``n`` is shaded with Phong's model for a directional light
    and a viewer at infinity (z is the camera's back axis, ``l`` points to the light, ``r = 2 (n.l)
    n - l`` is the mirrored light)::

        c * (ambient + diffuse * max(n.l, 0) + specular * s) + highlight * s,
        s = max(r_z, 0) ** shininess

    then clipped to [0, 1]. Each lamp, with its own l, s and strength a, adds ``a * (c * diffuse *
    max(n.l, 0) + highlight * s)``. A ``headlight`` h follows MuJoCo: it adds ``h * max(n_z, 0)`` to
    the ambient light, limits the sum of both to 1 on the ground, and multiplies highlights by the
    ground's color.

    Attributes:
        ground: static, ``"checker"`` or ``"grid"`` (thin dark lines), the pattern of planes that
            are ground, from the corner of finite planes, the middle of infinite ones.
        shadows: static, whether geoms cast shadows (without diffuse and specular light).
        shininess: static positive int, the exponent.
        light: (3,), world direction TO the light, any length but 0; None for no such light.
        ambient, diffuse, specular, highlight: () coefficients.
        sky: (2, 3), colors at and below the horizon, and straight above; or (3, 3), where the last
            one is straight below.
        ground_rgb: (2, 3), colors of the two checker tiles, or of tile and line.
        ground_pitch: (), metres, edge of a tile or distance between lines.
        ground_mark: (), in pitches, how far the second color reaches over every other tile edge.
        headlight: (), coefficient of diffuse light from the camera; None for none.
        headlight_highlight: (), its coefficient of highlights, with ``opengl``; None for none.
        lamps: spot lights.
        reflectance: (), fraction of the colors that a mirror reflects; None for no reflection.
        opengl: static, whether light is that of MuJoCo's renderer, see ``renderer.opengl``: the
            highlight is the half vector's, ``shininess`` is its exponent, and bounded planes that
            are ground are lit at the vertices of MuJoCo's grid, of half width ``size[2]``.
        sky_texture: (6, n, n, 3), what a texture adds to the sky's color, which is then clipped to
            [0, 1]: the faces of a cube map in OpenGL's order, with y up. None for no texture.
    """

    ground: str = struct.field(pytree_node=False)
    shadows: bool = struct.field(pytree_node=False)
    shininess: int = struct.field(pytree_node=False)
    light: jax.Array | None
    ambient: jax.Array
    diffuse: jax.Array
    specular: jax.Array
    highlight: jax.Array
    sky: jax.Array
    ground_rgb: jax.Array
    ground_pitch: jax.Array
    headlight: jax.Array | None = None
    lamps: tuple[Lamp, ...] = ()
    sky_texture: jax.Array | None = None
    headlight_highlight: jax.Array | None = None
    reflectance: jax.Array | None = None
    opengl: bool = struct.field(pytree_node=False, default=False)
    ground_mark: jax.Array | None = None


class Scene(struct.PyTreeNode):
    """Input of a renderer for one image, in the world frame.

    Attributes:
        geoms: shapes, sizes and colors.
        pos: (G, 3), geom centers; those of the world (link -1) as in ``geoms``.
        xmat: (G, 3, 3), geom orientations, likewise; columns are the geom's axes.
        camera: the viewpoint.
        look: light, sky and ground.
        sky_xmat: (3, 3), the camera's orientation for the sky's texture, so that a batch with one
            orientation reads the texture once for all; None for that of the camera.
    """

    geoms: Geoms
    pos: jax.Array
    xmat: jax.Array
    camera: Camera
    look: Look
    sky_xmat: jax.Array | None = None


class Frame(struct.PyTreeNode):
    """One image. Color channels are separate arrays, because stacking them early is slow on a CPU.

    Attributes:
        r, g, b: (H, W) in [0, 1].
        depth: (H, W), along the camera's viewing axis (not along the ray), ``FAR`` for the sky.
        seg: (H, W) int32, index of the visible geom, -1 for the sky.
        ground: (H, W) bool, whether a plane that is ground is visible; cheaper than ``seg``.
    """

    r: jax.Array
    g: jax.Array
    b: jax.Array
    depth: jax.Array
    seg: jax.Array
    ground: jax.Array


class Clips(struct.PyTreeNode):
    """Video clips on the device, in one array: C clips, T frames in all.

    Attributes:
        packed: (T, H, W) uint32, packed pixels: red in the low byte, then green, then blue.
        first: (C,) int32, index of a clip's first frame.
        length: (C,) int32, number of a clip's frames, at least 1.
    """

    packed: jax.Array
    first: jax.Array
    length: jax.Array


class DynamicsRanges(struct.PyTreeNode):
    """Lowest and highest multipliers of a task's dynamics, drawn for each episode.

    Attributes:
        friction: (2,), of contacts.
        mass: (2,), of all bodies, with their inertia.
        damping: (2,), of joints and tendons.
        gain: (2,), of the forces of actuators.
        gravity: (2,).
    """

    friction: jax.Array
    mass: jax.Array
    damping: jax.Array
    gain: jax.Array
    gravity: jax.Array


class EnvParams(struct.PyTreeNode):
    """Parameters of an environment that may be randomised; always an argument of jitted functions.

    Attributes:
        geoms: the shapes and their colors.
        rig: the ``CameraRig``; a tuple of them for several cameras.
        look: light, sky and ground.
        clips: background videos; None if no distractor shows any.
        episode_length: () int32, time limit in control steps.
        dynamics: ranges of the dynamics' multipliers; None if nothing varies.
    """

    geoms: Geoms
    rig: Any
    look: Look
    clips: Clips | None = None
    episode_length: Any = np.int32(1000)
    dynamics: DynamicsRanges | None = None


class SimState(struct.PyTreeNode):
    """Simulated part of an environment's state.

    Attributes:
        physics: the state of the physics.
        episode: () uint32, index of the current episode, from 0.
        step_count: () int32, control steps of this episode.
        time_limit_offset: () int32, control steps by which the time limit of this episode is
            shortened, 0 by default.
        episode_return: () float32, sum of rewards of this episode.
        done: () bool, the episode has ended and the next call must reset.
        distractor_state: tuple of the distractors' states.
    """

    physics: PhysicsState
    episode: jax.Array
    step_count: jax.Array
    time_limit_offset: jax.Array
    episode_return: jax.Array
    done: jax.Array
    distractor_state: Any = ()


class EnvState(struct.PyTreeNode):
    """State of one pixel environment.

    Attributes:
        sim: the simulated part.
        frames: the observation's images; (0, 0, 0) uint8 without any.
        key: typed PRNG key of the environment; never changes.
    """

    sim: SimState
    frames: Any
    key: jax.Array

    @property
    def done(self) -> jax.Array:
        """() bool, whether the episode has ended and the next call must reset."""
        return self.sim.done


class Timestep(struct.PyTreeNode):
    """Result of a reset or step.

    Attributes:
        obs: according to ``obs_mode``; a dictionary of several. ``"pixels"`` are (H, W, 3K) uint8,
            ``"depth"`` (H, W, K) in metres along the viewing axis, at most 100, ``"segmentation"``
            (H, W, K) int32, rows of ``EnvParams.geoms`` or -1 for the sky; oldest frame first.
            C cameras have C times the channels, or entries with ``camera_sizes``. ``"state"`` (S,).
        reward: (), 0 after a reset.
        terminated: () bool, the task ended.
        truncated: () bool, the time limit was reached; never together with ``terminated``.
        info: dictionary with fixed keys, see ``PixelEnv.step``.
    """

    obs: Any
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    info: dict[str, Any]
