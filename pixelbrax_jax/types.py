"""Every value that crosses from one module of the package to the next.

Shapes are those of ONE environment; a batch has the same fields with a leading axis. Letters: G
geoms, M materials, L links, S state features, A actions, H and W pixels, K stacked frames. Arrays
are float32 where nothing else is said. Lengths are metres, angles degrees, quaternions ``(w, x, y,
z)`` of length 1, colors linear in [0, 1]. The world is right-handed with z up. Row 0 of an image is
its top.

Fields marked *static* are Python values: they decide which program is compiled, hence they are
hashable and cannot be traced. All other fields are arrays and may be differentiated, batched or
randomised.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import IntEnum
from typing import Any, TypeVar

import jax
import numpy as np
from flax import struct

FAR = float(np.finfo(np.float32).max)
"""Metres, the depth where nothing is hit: the largest float32. Not infinity, which
``jax_debug_infs`` takes for a mistake."""


class GeomKind(IntEnum):
    """Shapes the renderer draws: one row each, beginning with MuJoCo's number (``mjtGeom``).

    All but the plane are convex. Their formulas are in ``renderer.intersect`` and, for the renderer
    that others are tested against, in ``renderer.reference``.

    Attributes:
        num_sizes: how many of a geom's three size numbers mean something.
        reach: which sphere around its center a geom is inside of: its radius is ``first``, the
            first size number; ``largest``, that of the three; ``diagonal``, their norm; or ``all``,
            for what has no end.
        is_long: whether that sphere is around both ends of the z axis, at the second size number.
        has_far_form: whether float32 needs a longer formula where the camera is far away.
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
        """Make a row, which is MuJoCo's number.

        Raises:
            TypeError: the number of sizes or the reach is missing or unknown.
        """
        if not 1 <= num_sizes <= 3 or reach not in ("first", "largest", "diagonal", "all"):
            raise TypeError(f"GeomKind {number} needs a number of sizes and a reach.")
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


_Formula = TypeVar("_Formula")


def for_each_kind(
    what: str, formulas: Mapping[GeomKind, _Formula], kinds: Iterable[GeomKind] = GeomKind
) -> Mapping[GeomKind, _Formula]:
    """Return a table with one entry for each kind of geom.

    Args:
        what: what the table has, for the message.
        formulas: the table.
        kinds: those that it must have.

    Raises:
        TypeError: it lacks a kind, or has one that it must not.
    """
    wrong = set(kinds) ^ set(formulas)
    if wrong:
        names = ", ".join(sorted(kind.name for kind in wrong))
        raise TypeError(f"{what} must have one entry for each kind of geom; wrong for {names}.")
    return formulas


class String(struct.PyTreeNode):
    """A thread between two points, drawn as a chain of capsules that hangs where it is slack.

    Attributes:
        geoms: static, rows of ``Geoms`` that are its pieces, in order; all capsules on no link.
        link: (2,) static, indices of the links that carry its ends, -1 for the world.
        ends: (2, 3), its ends in the frames of these links.
        length: (); a distance of the ends that is greater stretches it.
    """

    geoms: tuple[int, ...] = struct.field(pytree_node=False)
    link: tuple[int, int] = struct.field(pytree_node=False)
    ends: jax.Array
    length: jax.Array


class Geoms(struct.PyTreeNode):
    """The visible shapes of a task, each fixed in the frame of its link.

    Attributes:
        kind: (G,) static, values of ``GeomKind``.
        link: (G,) static, index of the carrying link, -1 for the world.
        material: (G,) static, row of ``rgb`` that colors the geom.
        name: (G,) static, the model's geom name, or ``kind/index`` where it has none.
        size: (G, 3), with MuJoCo's meaning per kind: radius, half length, half extents.
        pos: (G, 3), in the link's frame.
        quat: (G, 4), in the link's frame.
        rgb: (M, 3), one color per material.
        bounded: (G,) static, planes that end at their size along their x and y, where a size of
            0 is no end. Empty where no plane ends, whatever its size.
        patterned: (G,) static, planes that are ground: drawn with the look's pattern, others in
            their own color. Empty where every plane is.
        distant: static, whether the camera is so far away, a thousand radii of a sphere or capsule,
            that float32 needs the longer formulas of ``renderer.intersect``.
        strings: threads, the pieces of which are among the geoms.
        material_name: (M,) static, the model's name for the material of the first geom of each
            color. Empty where none is known.
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
    distant: bool = struct.field(pytree_node=False, default=False)
    strings: tuple[String, ...] = ()
    material_name: tuple[str, ...] = struct.field(pytree_node=False, default=())

    def is_bounded(self, geom: int) -> bool:
        """Return whether a geom is a plane that ends."""
        return bool(self.bounded) and self.bounded[geom]

    def is_ground(self, geom: int) -> bool:
        """Return whether a geom is a plane with the look's pattern."""
        plane = self.kind[geom] == GeomKind.PLANE
        return plane and (not self.patterned or self.patterned[geom])


class PhysicsState(struct.PyTreeNode):
    """What physics hands to the rest of the package after a step.

    Attributes:
        engine: the engine's own state, opaque to everyone else.
        xpos: (L, 3), link origins in the world frame.
        xquat: (L, 4), link orientations in the world frame.
        obs: (S,), the task's state observation.
        reward: (), of the step that led here, 0 after a reset.
        terminated: () bool, the task ended (never a time limit).
        non_finite: () bool, the step diverged; the pose shown is then the last finite one.
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
        xmat: (3, 3), columns are the camera's right, up and back directions; it looks along
            minus its third column, as MuJoCo's and OpenGL's cameras do.
        fovy: (), vertical field of view.
    """

    pos: jax.Array
    xmat: jax.Array
    fovy: jax.Array


class CameraRig(struct.PyTreeNode):
    """A camera that may follow a link.

    Eye and target are ``offset + track * xpos[link]``; the orientation never follows.

    Attributes:
        link: static, index of the followed link, -1 to follow nothing.
        track: (3,), fraction of the link's position that is followed, per world axis.
        eye: (3,).
        target: (3,), the point looked at.
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

    It stands at ``offset + xpos[link]`` and never turns. A point at direction d from it (unit
    length) is lit by ``max(d.axis, 0) ** exponent`` of its strength, and not at all if the angle
    between d and the axis exceeds the cutoff.

    Attributes:
        link: static, index of the followed link, -1 for a lamp at rest.
        exponent: static int, at least 0.
        pos: (3,), the offset; in a scene the place in the world.
        axis: (3,), unit, world direction in which it shines.
        cos_cutoff: (), cosine of the angle at which its light ends; -1 for none.
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

    A surface of color ``c`` with normal ``n`` is shaded with Phong's model for a directional
    light and a viewer at infinity (z is the camera's back axis, ``l`` points to the light,
    ``r = 2 (n.l) n - l`` is the mirrored light)::

        c * (ambient + diffuse * max(n.l, 0) + specular * s) + highlight * s,
        s = max(r_z, 0) ** shininess

    then clipped to [0, 1]. Lamps (each with its own l, s and strength a) add to that
    ``a * (c * diffuse * max(n.l, 0) + highlight * s)``. With a ``headlight`` h the picture is
    MuJoCo's: there is ``h * max(n_z, 0)`` more ambient light, the sum of both is at most 1 on the
    ground, and highlights are multiplied by the ground's color.

    Attributes:
        ground: static, ``"checker"`` or ``"grid"`` (thin dark lines), drawn on planes that are
            ground, from the corner of those that end and from the middle of others.
        shadows: static, whether geoms cast shadows (diffuse and specular light vanish there).
        shininess: static positive int, the exponent.
        light: (3,) float32, world direction from the scene TO the light, any length but 0; None
            for no such light.
        ambient, diffuse, specular, highlight: () float32 coefficients.
        sky: (2, 3) float32, color at and below the horizon, and straight above; or (3, 3), and
            straight below.
        ground_rgb: (2, 3) float32, colors of the two checker tiles, or of tile and line.
        ground_pitch: () float32, metres, edge of one tile or distance of two lines.
        headlight: () float32, coefficient of diffuse light from the camera's side; None for none.
        lamps: spot lights.
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


class Scene(struct.PyTreeNode):
    """Everything a renderer needs for one image, in the world frame.

    Attributes:
        geoms: shapes, sizes and colors.
        pos: (G, 3), geom centers.
        xmat: (G, 3, 3), geom orientations; columns are the geom's axes.
        camera: the viewpoint.
        look: light, sky and ground.
    """

    geoms: Geoms
    pos: jax.Array
    xmat: jax.Array
    camera: Camera
    look: Look


class Frame(struct.PyTreeNode):
    """One image. Color channels stay apart: stacking them early costs a CPU dearly.

    Attributes:
        r, g, b: (H, W) in [0, 1].
        depth: (H, W), along the camera's viewing axis (not along the ray), ``FAR`` where nothing is
            hit.
        seg: (H, W) int32, index of the geom seen, -1 for the sky.
        ground: (H, W) bool, a plane that is ground is seen; cheaper to ask than ``seg``.
    """

    r: jax.Array
    g: jax.Array
    b: jax.Array
    depth: jax.Array
    seg: jax.Array
    ground: jax.Array


class Clips(struct.PyTreeNode):
    """Video clips on the device, one after the other. C clips, T frames in all.

    Attributes:
        packed: (T, H, W) uint32, packed pixels: red in the low byte, then green, then blue.
        first: (C,) int32, index of a clip's first frame.
        length: (C,) int32, frames of a clip, at least 1.
    """

    packed: jax.Array
    first: jax.Array
    length: jax.Array


class EnvParams(struct.PyTreeNode):
    """The part of an environment that may be randomised; always a jit argument.

    Attributes:
        geoms: the shapes and their colors.
        rig: the camera rig.
        look: light, sky and ground.
        clips: videos for the background; None where no distractor shows any.
        episode_length: () int32, time limit in control steps.
    """

    geoms: Geoms
    rig: CameraRig
    look: Look
    clips: Clips | None = None
    episode_length: Any = np.int32(1000)


class SimState(struct.PyTreeNode):
    """What is simulated of one pixel environment.

    Attributes:
        physics: the state of the physics.
        episode: () uint32, index of the current episode, 0 first.
        step_count: () int32, control steps taken in this episode.
        time_limit_offset: () int32, control steps by which the time limit comes early in this
            episode; 0 unless somebody has set it.
        episode_return: () float32, sum of rewards of this episode.
        done: () bool, the episode has ended and the next call must reset.
        distractor_state: states of the distractors, a tuple.
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
        sim: what is simulated.
        frames: (H, W, 3K) uint8, the frame stack, oldest first; (0, 0, 0) without pixels.
        key: typed PRNG key of the environment; never changes.
    """

    sim: SimState
    frames: jax.Array
    key: jax.Array

    @property
    def done(self) -> jax.Array:
        """() bool, the episode has ended and the next call must reset."""
        return self.sim.done


class Timestep(struct.PyTreeNode):
    """What an agent sees after a reset or a step.

    Attributes:
        obs: uint8 (H, W, 3K) pixels, oldest frame first; or (S,) state; or a dict of both under
            ``"pixels"`` and ``"state"``, as ``obs_mode`` says.
        reward: (), 0 after a reset.
        terminated: () bool, the task ended.
        truncated: () bool, the time limit was reached; never together with ``terminated``.
        info: dict with a fixed set of keys, see ``PixelEnv.step``.
    """

    obs: Any
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    info: dict[str, Any]
