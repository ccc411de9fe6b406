"""Whether JAX and PyTorch work together on this machine, in plain words and with fixes."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

from pixelbrax_gym.bench.machine import installed_version
from pixelbrax_jax.cache import cache_folder
from pixelbrax_jax.extras import install_extra

_PACKAGES = ("pixelbrax", "jax", "jaxlib", "brax", "mujoco", "gymnasium", "numpy")
EXTRAS = {
    "torch": "torch",
    "torchrl": "torchrl",
    "stable-baselines3": "sb3",
    "dm-control": "dmc",
}
"""Package -> the extra that brings it."""

_JAX_ON_CUDA = install_extra("cuda12", "cuda13")
_GPUS = ("gpu", "cuda", "rocm")
_FRACTIONS = ("XLA_CLIENT_MEM_FRACTION", "XLA_PYTHON_CLIENT_MEM_FRACTION")
"""Variables for JAX's share of a GPU's memory, the current one and the old one."""
_PATIENCE = 120.0  # seconds; a GPU's driver takes tens of them


class _Variable(NamedTuple):
    """An environment variable that other tools leave behind."""

    package: str  # that reads it
    code: str  # fails if the package cannot work with the variable's value
    level: str  # as in Finding
    effect: str  # what no longer works


VARIABLES = {
    "XLA_FLAGS": _Variable("jax", "import jax; jax.devices()", "problem", "JAX cannot start"),
    "MUJOCO_GL": _Variable(
        "mujoco",
        "import mujoco.rendering.classic.gl_context",
        "note",
        "MuJoCo's own renderer cannot start; PixelBrax does not use it",
    ),
    "IMAGEIO_FFMPEG_EXE": _Variable(
        "imageio-ffmpeg",
        "from pixelbrax_jax.ffmpeg import check_ffmpeg; check_ffmpeg()",
        "problem",
        "videos can be neither read nor written",
    ),
    "SDL_VIDEODRIVER": _Variable(
        "pygame", "import pygame; pygame.display.init()", "note", "no window can be opened"
    ),
    "MPLBACKEND": _Variable(
        "matplotlib",
        "import matplotlib.pyplot",
        "note",
        "matplotlib cannot be imported; PixelBrax's plots do not heed it",
    ),
}


@dataclass(frozen=True)
class Machine:
    """What ``inspect`` found out."""

    versions: dict[str, str | None]
    """Package -> installed release, None where there is none."""
    jax_device: str | None
    """JAX's default device, as ``cuda:0``."""
    jax_platform: str | None
    """``cpu``, ``gpu``, ``tpu``, ..."""
    jax_error: str | None
    """Why JAX has no device."""
    has_nvidia: bool
    """Whether the system has an NVIDIA GPU."""
    torch_cuda: bool | str | None
    """Whether torch can use CUDA; None without torch, or why it cannot be imported."""
    to_torch: bool | str | None
    """Whether an array became a tensor on the same memory; None without torch, or what failed."""
    to_jax: bool | str | None
    """The same, from a tensor to an array."""
    renderer: tuple[str, str] | None
    """What ``renderer="auto"`` stands for, and why; None where JAX has no device."""
    gl_libraries: tuple[str, ...] | None
    """OpenGL libraries loaded into this process; None where that is unknown."""
    environ: dict[str, str]
    """Environment variables."""
    broken: dict[str, str]
    """Of ``VARIABLES``, what fails because of them."""
    cache: str
    """Why nothing can be kept in the cache; empty where it can."""


class Finding(NamedTuple):
    """One line of the report."""

    level: str
    """``ok``, ``note`` (works, but could be better) or ``problem``."""
    text: str
    fix: str = ""
    """What to do, where there is something to do."""


def diagnose(machine: Machine) -> list[Finding]:
    """Return what the facts mean, the most basic first."""
    return list(_findings(machine))


def _findings(m: Machine) -> Iterator[Finding]:
    ok, note, problem = (partial(Finding, level) for level in ("ok", "note", "problem"))
    here = ", ".join(f"{name} {release}" for name, release in m.versions.items() if release)
    yield ok(f"Python {platform.python_version()}, {here}")
    for name, extra in EXTRAS.items():
        if m.versions[name] is None:
            yield note(f"{name} is not installed", f"{install_extra(extra)}, should you want it")

    on_cpu, on_gpu = m.jax_platform == "cpu", m.jax_platform in _GPUS
    if m.jax_error is None:
        yield ok(f"JAX computes on {m.jax_device}")
        if on_cpu and m.has_nvidia:
            yield problem(
                "there is an NVIDIA GPU, but JAX does not use it",
                f"{_JAX_ON_CUDA}, as nvidia-smi tells the CUDA version; unset JAX_PLATFORMS; and "
                "import jax before torch, whose CUDA libraries may hide JAX's",
            )
        yield from _about_torch(m, on_cpu, on_gpu)
    elif "XLA_FLAGS" not in m.broken:
        platforms = m.environ.get("JAX_PLATFORMS")
        yield problem(
            f"JAX finds no device to compute on: {m.jax_error}"
            + (f" (JAX_PLATFORMS={platforms})" if platforms else ""),
            "unset JAX_PLATFORMS, or install the jax release that goes with your driver: "
            + _JAX_ON_CUDA,
        )
    if m.renderer is not None:
        name, why = m.renderer
        unexpected = on_gpu and m.has_nvidia and name != "pallas"
        yield (note if unexpected else ok)(f"images are drawn by renderer={name!r}: {why}")

    for way, result in (("JAX to torch", m.to_torch), ("torch to JAX", m.to_jax)):
        if result is True:
            yield ok(f"arrays cross from {way} without a copy")
        elif result is False:
            yield problem(
                f"arrays are copied on their way from {way}",
                "use a current torch and jax; the releases in constraints.txt do not copy",
            )
        elif result is not None:
            yield problem(
                f"arrays do not cross from {way}: {result}",
                "mend the devices first; else use output='numpy'",
            )

    new, old = _FRACTIONS
    if new in m.environ and old in m.environ:
        yield problem(f"{new} and {old} are both set, which JAX refuses", f"unset {old}")
    share = _memory_share(m.environ)
    if on_gpu and share <= 0.5:
        yield ok("JAX leaves GPU memory for others")
    elif on_gpu and m.torch_cuda:
        yield note(
            f"JAX takes {share:.0%} of the GPU's memory at its start and leaves torch the rest",
            f"export {new}=0.4, or XLA_PYTHON_CLIENT_PREALLOCATE=false, before Python starts",
        )

    if m.gl_libraries:
        names = ", ".join(m.gl_libraries)
        yield note(f"images need no OpenGL, though something else has loaded {names}")
    else:
        yield ok("images need no OpenGL and no display")
    for name, why in m.broken.items():
        level, effect = VARIABLES[name].level, VARIABLES[name].effect
        text = f"with {name}={m.environ.get(name, '')}, {effect}: {why}"
        yield Finding(level, text, f"unset {name}, or mend it")
    if m.cache:
        yield note(
            f"clips are read anew each time, as they cannot be cached: {m.cache}",
            "export PIXELBRAX_CACHE=<a folder that can be written>",
        )


def _about_torch(m: Machine, on_cpu: bool, on_gpu: bool) -> Iterator[Finding]:
    site = "https://pytorch.org/get-started/locally"
    if isinstance(m.torch_cuda, str):
        yield Finding(
            "problem",
            f"torch is installed and cannot be imported: {m.torch_cuda}",
            f"install it again, see {site}",
        )
    elif m.torch_cuda is None:
        return
    elif not on_cpu and not on_gpu:
        yield Finding(
            "note",
            f"torch cannot share the memory of a {m.jax_platform}",
            "use output='numpy' or output='jax'",
        )
    elif on_cpu and m.torch_cuda:
        yield Finding(
            "problem",
            "torch uses CUDA and JAX the CPU: frames are drawn slowly and must be copied",
            _JAX_ON_CUDA,
        )
    elif on_gpu and not m.torch_cuda:
        yield Finding(
            "problem",
            "JAX uses the GPU and torch cannot: output='torch' will not work",
            f"install a torch built for CUDA, see {site}",
        )
    else:
        yield Finding("ok", "JAX and torch see the same device")


def _memory_share(environ: Mapping[str, str]) -> float:
    """Return the share of a GPU's memory that JAX takes at its start, by JAX's own rules."""
    if environ.get("XLA_PYTHON_CLIENT_PREALLOCATE") in ("false", "False", "0"):
        return 0.0
    if environ.get("XLA_PYTHON_CLIENT_ALLOCATOR", "").lower() in ("platform", "cuda_async"):
        return 0.0
    try:
        return float(environ.get(_FRACTIONS[0]) or environ.get(_FRACTIONS[1]) or 0.75)
    except ValueError:
        return 0.75


def report(findings: list[Finding]) -> str:
    """Return the findings as text for a terminal."""
    lines = []
    for finding in findings:
        lines.append(f"{finding.level:>8}  {finding.text}")
        if finding.fix:
            lines.append(f"{'':>8}  -> {finding.fix}")
    problems = sum(finding.level == "problem" for finding in findings)
    end = f"{problems} problem{'s' if problems > 1 else ''} found." if problems else "All is well."
    return "\n".join([*lines, "", end])


def inspect() -> Machine:
    """Look at this machine. Starts JAX; takes a second or two."""
    versions = {name: installed_version(name) for name in (*_PACKAGES, *EXTRAS)}
    device = jax_platform = jax_error = renderer = None
    broken = broken_variables()
    try:
        if "XLA_FLAGS" in broken:  # XLA would end this process
            raise RuntimeError(broken["XLA_FLAGS"])
        import jax

        from pixelbrax_jax.renderer.choice import auto_renderer

        first = jax.devices()[0]
        device, jax_platform = str(first), first.platform
        renderer = auto_renderer()
    except Exception as error:  # whatever it is, it shall be reported and not raised
        jax_error = f"{type(error).__name__}: {error}"
    torch_cuda: bool | str | None = None
    to_torch: bool | str | None = None
    to_jax: bool | str | None = None
    if versions["torch"] is not None:
        torch_cuda = _attempt(_torch_has_cuda)
        sharing = jax_platform == "cpu" or jax_platform in _GPUS
        if jax_error is None and sharing and isinstance(torch_cuda, bool):
            to_torch, to_jax = _attempt(_shares_to_torch), _attempt(_shares_to_jax)
    return Machine(
        versions=versions,
        jax_device=device,
        jax_platform=jax_platform,
        jax_error=jax_error,
        has_nvidia=Path("/proc/driver/nvidia/version").exists(),
        torch_cuda=torch_cuda,
        to_torch=to_torch,
        to_jax=to_jax,
        renderer=renderer,
        gl_libraries=_gl_libraries(),
        environ=dict(os.environ),
        broken=broken,
        cache=why_no_cache(),
    )


def broken_variables() -> dict[str, str]:
    """Try each variable that is set in a process of its own, which some of them end."""
    broken = {}
    for name, variable in VARIABLES.items():
        if not os.environ.get(name) or installed_version(variable.package) is None:
            continue
        without = {key: value for key, value in os.environ.items() if key != name}
        why = _why_it_fails(variable.code, dict(os.environ))
        # What fails in the same way without it has another cause.
        if why and why != _why_it_fails(variable.code, without):
            broken[name] = why
    return broken


def _why_it_fails(code: str, environ: dict[str, str]) -> str:
    """Return the last line of what a program says of its failure; empty if it passes."""
    command = [sys.executable, "-c", code]
    try:
        result = subprocess.run(
            command, env=environ, capture_output=True, text=True, check=False, timeout=_PATIENCE
        )
    except subprocess.TimeoutExpired:
        return f"no end after {_PATIENCE:.0f} s"
    last = result.stderr.strip().rpartition("\n")[2][:200]
    return (last or f"exit status {result.returncode}") if result.returncode else ""


def why_no_cache() -> str:
    """Return why nothing can be kept in the cache; empty where it can."""
    try:
        folder = cache_folder().absolute()
        while not folder.exists():
            folder = folder.parent
    except OSError as error:
        return str(error)
    return "" if os.access(folder, os.W_OK) else f"{folder} cannot be written"


def _attempt(check: Callable[[], bool]) -> bool | str:
    try:
        return bool(check())
    except Exception as error:  # reported, not raised
        return f"{type(error).__name__}: {error}"


def _torch_has_cuda() -> bool:
    import torch

    return bool(torch.cuda.is_available())


def _shares_to_torch() -> bool:
    import jax
    import jax.numpy as jnp

    from pixelbrax_gym.interop.dlpack import to_torch

    frames = jax.block_until_ready(jnp.zeros((2, 8, 8, 3), jnp.uint8))
    return bool(to_torch(frames).data_ptr() == frames.unsafe_buffer_pointer())


def _shares_to_jax() -> bool:
    import jax
    import torch

    from pixelbrax_gym.interop.dlpack import default_torch_device

    # Larger than any alignment asks for, as an allocator aligns what is large.
    tensor = torch.zeros(1 << 16, device=default_torch_device())
    array = jax.block_until_ready(jax.dlpack.from_dlpack(tensor))
    return bool(array.unsafe_buffer_pointer() == tensor.data_ptr())


def _gl_libraries() -> tuple[str, ...] | None:
    """Return the OpenGL libraries in this process, which has imported all that draws a frame."""
    maps = Path("/proc/self/maps")
    if not sys.platform.startswith("linux") or not maps.exists():
        return None
    names = {Path(line.split()[-1]).name for line in maps.read_text().splitlines() if "/" in line}
    libraries = ("libGL.", "libEGL.", "libOSMesa.", "libGLX.")
    return tuple(sorted(name for name in names if name.startswith(libraries)))
