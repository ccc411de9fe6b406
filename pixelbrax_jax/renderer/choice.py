"""Choice of the kernel of `kernel.py` on NVIDIA GPUs, if it exists and passes a check."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib.util import find_spec
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax import spatial
from pixelbrax_jax.flags import PRECISION, default_flags
from pixelbrax_jax.renderer import fused
from pixelbrax_jax.types import Camera, Frame, GeomKind, Geoms, Lamp, Look, Scene

_PLUGINS = "jax_cuda12_plugin", "jax_cuda13_plugin"

_CAPABILITY = 8.0
"""Least compute capability of XLA's Triton kernels: Ampere."""

_HEIGHT, _WIDTH = 24, 40

_EYES = ((-2.0, -4.25, 2.25), (0.72, -4.25, 1.75))
"""Camera positions of the check, metres. No edge goes through the middle of a pixel."""

_COLOR = 1.0 / 255.0
"""Largest difference of colors from rounding."""

_DEPTH = 1e-4
"""Largest relative difference of depths from rounding."""


class KernelCheck(NamedTuple):
    """Result of comparing the kernel with the fused renderer.

    ``text`` is what was compared, or what differs, as a sentence without its period.
    """

    passed: bool
    text: str


def auto_renderer() -> tuple[str, str]:
    """Return the renderer that ``"auto"`` means on JAX's default device, and the reason."""
    if jax.default_backend() != "gpu":
        return "fused", f"JAX computes on a {jax.default_backend()}; the kernel is for NVIDIA GPUs"
    why = why_no_kernel()
    if why is not None:
        return "fused", f"not by one kernel: {why}"
    return "pallas", f"by one kernel, on {jax.devices()[0].device_kind}; {kernel_check().text}"


def why_no_kernel() -> str | None:
    """Return why ``"auto"`` does not use the kernel on CUDA; None if it does.

    Starts a device. On an NVIDIA GPU the first call in a process checks the kernel, with programs
    of its own, and warns if it fails. Programs compiled for CUDA without a GPU use it unchecked.
    """
    why = why_unsupported()
    if why is None and jax.default_backend() == "gpu":
        check = kernel_check()
        return None if check.passed else check.text
    return why


def why_unsupported() -> str | None:
    """Return why programs for CUDA cannot use the kernel; None if they can.

    With JAX's CUDA plugin, programs can be compiled for a GPU on a machine without one. jax
    0.12.0.1 must be told the GPU, jax 0.10.2 need not; see `docs/renderer.md`.
    """
    platform = jax.default_backend()
    # Without a plugin nothing for GPUs is imported or traced.
    if platform != "gpu" and not any(map(find_spec, _PLUGINS)):
        return f"JAX computes on a {platform}; the kernel is for NVIDIA GPUs"
    device = jax.devices()[0]
    if platform == "gpu" and "rocm" in _driver(device).lower():
        return "JAX computes on ROCm; the kernel is for NVIDIA GPUs"
    try:
        from jax.experimental.pallas import triton

        # In jax 0.12.0.1 this describes an abstract or a real GPU; 0.10.2 has no such function.
        if hasattr(triton, "get_gpu_info"):
            card, capability = "the card", triton.get_gpu_info().compute_capability / 10
        elif platform == "gpu":
            card, capability = device.device_kind, float(device.compute_capability)
        else:
            return None
    except ImportError:
        return f"jax {jax.__version__} has no Pallas for Triton"
    except (AttributeError, ValueError) as error:
        return f"Pallas does not know the card: {error}"
    if capability < _CAPABILITY:
        return f"{card} has compute capability {capability}, and the kernel needs {_CAPABILITY}"
    return None


def why_not_here() -> str | None:
    """Return why JAX's default device cannot run the kernel, checked or not; None if it can."""
    why = why_unsupported()
    if why is None and jax.default_backend() != "gpu":
        return f"JAX computes on a {jax.default_backend()}"
    return why


@cache
def kernel_check() -> KernelCheck:
    """Check the kernel on JAX's default device, a GPU, once per process; warn if it fails."""
    from pixelbrax_jax.renderer import kernel

    check = compare(kernel.render)
    if not check.passed:
        card = jax.devices()[0]
        warnings.warn(
            f"PixelBrax does not use its kernel for NVIDIA GPUs: {check.text} ({card.device_kind}, "
            f"jax {jax.__version__}, {' '.join(_driver(card).split())}). renderer='fused' renders "
            "images instead, correctly but slower. Please report this line with the output of "
            "`pixelbrax doctor`; renderer='fused' silences it.",
            RuntimeWarning,
            stacklevel=2,
        )
    return check


def compare(draw: Callable[..., Frame]) -> KernelCheck:
    """Compare ``draw``, called like ``fused.render``, with that on images of all geoms."""
    # In a separate thread nothing is being traced, and JAX has its default settings.
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(_compare, draw).result()


def _compare(draw: Callable[..., Frame]) -> KernelCheck:
    def images(draw: Callable[..., Frame]) -> Frame:
        frames = jax.jit(jax.vmap(lambda scene: draw(scene, _HEIGHT, _WIDTH, 0, _HEIGHT)))(scenes)
        return jax.tree.map(np.asarray, frames)

    with default_flags(), jax.default_matmul_precision(PRECISION), jax.disable_jit(False):
        scenes = jax.jit(jax.vmap(_scene))(np.array(_EYES))
        wanted = images(fused.render)
        try:
            found = images(draw)
        except Exception as error:  # of a compiler or a driver, whatever it is
            lines = str(error).splitlines() or [""]
            return KernelCheck(False, f"it fails with {type(error).__name__}: {lines[0]}")
    colors = np.abs([getattr(found, c) - getattr(wanted, c) for c in "rgb"]).max(0)
    depths = np.abs(found.depth / wanted.depth - 1.0)
    right = (found.seg == wanted.seg) & (found.ground == wanted.ground)
    # Comparisons with NaN are False.
    right &= (colors <= _COLOR) & (depths <= _DEPTH)
    if right.all():
        return KernelCheck(True, f"it renders {right.size} pixels like renderer='fused'")
    return KernelCheck(
        False,
        f"{(~right).sum()} of {right.size} pixels differ from those of renderer='fused', colors by "
        f"up to {255.0 * colors.max():.0f} of 255, depth by up to {100.0 * depths.max():.2g} %",
    )


def _scene(eye: jax.Array) -> Scene:
    """Return one of each kind of geom on ground that reflects, with light and shadows."""
    kinds = tuple(GeomKind)
    angles = jnp.linspace(0.3, 1.2, len(kinds))
    axes = jnp.array([[0.0, 0.0, 0.0]] + [[0.6, 0.0, 0.8]] * (len(kinds) - 1))
    quat = jnp.concatenate([jnp.cos(angles)[:, None], jnp.sin(angles)[:, None] * axes], axis=1)
    x = jnp.linspace(-1.8, 1.5, len(kinds))
    pos = jnp.stack([x, 0.3 * jnp.cos(3.0 * x), jnp.full(len(kinds), 0.6)], axis=1)
    target, up = jnp.array([0.0, 0.0, 0.5]), jnp.array([0.0, 0.0, 1.0])
    # The mesh is an octahedron, whose corners are 0.29 m from its center.
    signs = jnp.stack(jnp.meshgrid(*[jnp.array([-1.0, 1.0])] * 3), axis=-1).reshape(8, 3)
    planes = jnp.concatenate([spatial.unit(signs), jnp.full((8, 1), 0.17)], axis=1)
    geoms = Geoms(
        kind=kinds,
        link=(-1,) * len(kinds),
        material=tuple(range(len(kinds))),
        name=tuple(kind.name for kind in kinds),
        size=jnp.tile(jnp.array([0.3, 0.4, 0.25]), (len(kinds), 1)),
        pos=pos,
        quat=quat,
        rgb=jnp.linspace(0.1, 0.9, 3 * len(kinds)).reshape(-1, 3),
        num_planes=tuple(len(planes) if kind == GeomKind.MESH else 0 for kind in kinds),
        planes=planes,
        mirror=kinds.index(GeomKind.PLANE),
    )
    lamp = Lamp(
        link=-1,
        exponent=2,
        pos=jnp.array([2.0, -2.0, 3.0]),
        axis=spatial.unit(jnp.array([-0.6, 0.6, -0.9])),
        cos_cutoff=jnp.float32(0.5),
        diffuse=jnp.float32(0.3),
        highlight=jnp.float32(0.2),
    )
    look = Look(
        ground="checker",
        shadows=True,
        shininess=8,
        light=jnp.array([-0.5, -0.8, 2.0]),
        ambient=jnp.float32(0.3),
        diffuse=jnp.float32(0.5),
        specular=jnp.float32(0.1),
        highlight=jnp.float32(0.2),
        sky=jnp.array([[0.8, 0.8, 0.9], [0.2, 0.4, 0.8]]),
        ground_rgb=jnp.array([[0.3, 0.4, 0.5], [0.6, 0.6, 0.5]]),
        ground_pitch=jnp.float32(1.0),
        reflectance=jnp.float32(0.2),
        lamps=(lamp,),
    )
    return Scene(
        geoms=geoms,
        pos=pos.at[0].set(0.0),
        xmat=jax.vmap(spatial.quat_to_mat)(spatial.quat_normalize(quat)).at[0].set(jnp.eye(3)),
        camera=Camera(pos=eye, xmat=spatial.look_at(eye, target, up), fovy=jnp.float32(45.0)),
        look=look,
    )


def _driver(device: jax.Device) -> str:
    return getattr(device.client, "platform_version", "")
