"""Whether JAX and PyTorch work together on this machine, in plain words and with fixes."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from pixelbrax_jax.cache import cache_folder
from pixelbrax_jax.extras import install_extra

_PACKAGES = ("pixelbrax", "jax", "jaxlib", "brax", "mujoco", "gymnasium", "numpy")
_OPTIONAL = {
    "torch": "torch",
    "torchrl": "torchrl",
    "stable-baselines3": "sb3",
    "dm-control": "dmc",
}
"""Package -> the extra that brings it."""

_JAX_ON_CUDA = install_extra("cuda12", "cuda13")

_GL_LIBRARIES = ("libGL.", "libEGL.", "libOSMesa.", "libGLX.")

_GPUS = ("gpu", "cuda", "rocm")

_PREALLOCATE = "XLA_PYTHON_CLIENT_PREALLOCATE"
_FRACTION = "XLA_CLIENT_MEM_FRACTION"
_OLD_FRACTION = "XLA_PYTHON_CLIENT_MEM_FRACTION"
_ALLOCATOR = "XLA_PYTHON_CLIENT_ALLOCATOR"

_XLA_FLAGS = "XLA_FLAGS"

_PATIENCE = 120.0  # seconds; a GPU's driver takes tens of them


@dataclass(frozen=True)
class _Variable:
    """An environment variable that other tools leave behind.

    Attributes:
        package: the package that reads it.
        code: a program that fails if the package cannot work with the variable's value.
        level: how bad that is, as in ``Finding``.
        text: what no longer works.
    """

    package: str
    code: str
    level: str
    text: str


_VARIABLES = {
    _XLA_FLAGS: _Variable("jax", "import jax; jax.devices()", "problem", "JAX cannot start"),
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
    """What was found out; see ``inspect``.

    Attributes:
        versions: package -> installed release, None where there is none.
        jax_device: JAX's default device, e.g. ``"cuda:0"``.
        jax_platform: ``"cpu"``, ``"gpu"``, ``"tpu"``, ...
        jax_error: why JAX has no device, else None.
        has_nvidia: whether the system has an NVIDIA GPU.
        torch_cuda: whether torch can use CUDA; None without torch, or why it cannot be imported.
        to_torch: whether an array of JAX's became a tensor on the same memory; None without
            torch, or an explanation where it failed.
        to_jax: the same, from a tensor to an array.
        renderer: what ``renderer="auto"`` stands for, and why; None where JAX has no device.
        gl_libraries: OpenGL libraries loaded into this process; None where that is unknown.
        environ: environment variables.
        broken: environment variable -> what fails because of it, of those that often are left
            behind by other tools.
        cache: why nothing can be kept in the cache; empty where it can.
    """

    versions: dict[str, str | None]
    jax_device: str | None
    jax_platform: str | None
    jax_error: str | None
    has_nvidia: bool
    torch_cuda: bool | str | None
    to_torch: bool | str | None
    to_jax: bool | str | None
    renderer: tuple[str, str] | None
    gl_libraries: tuple[str, ...] | None
    environ: dict[str, str]
    broken: dict[str, str]
    cache: str


@dataclass(frozen=True)
class Finding:
    """One line of the report.

    Attributes:
        level: ``"ok"``, ``"note"`` (works, but could be better) or ``"problem"``.
        text: what was found.
        fix: what to do, where there is something to do.
    """

    level: str
    text: str
    fix: str = ""


def inspect() -> Machine:
    """Look at this machine. Starts JAX; takes a second or two."""
    versions = {name: _version(name) for name in (*_PACKAGES, *_OPTIONAL)}
    device = jax_platform = jax_error = renderer = None
    broken = _broken_variables()
    try:
        if _XLA_FLAGS in broken:  # XLA would end this process
            raise RuntimeError(broken[_XLA_FLAGS])
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
        cache=_why_no_cache(),
    )


def diagnose(machine: Machine) -> list[Finding]:
    """Return what the facts mean.

    Args:
        machine: the facts.

    Returns:
        Findings, the most basic first.
    """
    return [
        *_about_packages(machine),
        *_about_devices(machine),
        *_about_renderer(machine),
        *_about_sharing(machine),
        *_about_memory(machine),
        *_about_gl(machine),
        *_about_variables(machine),
        *_about_cache(machine),
    ]


def report(findings: list[Finding]) -> str:
    """Return the findings as text for a terminal."""
    lines = []
    for finding in findings:
        lines.append(f"{finding.level:>8}  {finding.text}")
        if finding.fix:
            lines.append(f"{'':>8}  -> {finding.fix}")
    problems = sum(finding.level == "problem" for finding in findings)
    lines.append("")
    lines.append(
        f"{problems} problem{'s' if problems > 1 else ''} found." if problems else "All is well."
    )
    return "\n".join(lines)


def _about_packages(machine: Machine) -> Iterator[Finding]:
    here = ", ".join(f"{name} {version}" for name, version in machine.versions.items() if version)
    yield Finding("ok", f"Python {platform.python_version()}, {here}")
    for name, extra in _OPTIONAL.items():
        if machine.versions[name] is None:
            fix = f"{install_extra(extra)}, should you want it"
            yield Finding("note", f"{name} is not installed", fix)


def _about_devices(machine: Machine) -> Iterator[Finding]:
    if _XLA_FLAGS in machine.broken:  # told of with the other variables
        return
    if machine.jax_error is not None:
        platforms = machine.environ.get("JAX_PLATFORMS")
        yield Finding(
            "problem",
            f"JAX finds no device to compute on: {machine.jax_error}"
            + (f" (JAX_PLATFORMS={platforms})" if platforms else ""),
            "unset JAX_PLATFORMS, or install the jax release that goes with your driver: "
            + _JAX_ON_CUDA,
        )
        return
    yield Finding("ok", f"JAX computes on {machine.jax_device}")
    on_cpu = machine.jax_platform == "cpu"
    if on_cpu and machine.has_nvidia:
        yield Finding(
            "problem",
            "there is an NVIDIA GPU, but JAX does not use it",
            f"{_JAX_ON_CUDA}, as nvidia-smi tells the CUDA version; unset JAX_PLATFORMS; and "
            "import jax before torch, whose CUDA libraries may hide JAX's",
        )
    if machine.torch_cuda is None:
        return
    on_gpu = machine.jax_platform in _GPUS
    if isinstance(machine.torch_cuda, str):
        yield Finding(
            "problem",
            f"torch is installed and cannot be imported: {machine.torch_cuda}",
            "install it again, see https://pytorch.org/get-started/locally",
        )
    elif not on_cpu and not on_gpu:
        yield Finding(
            "note",
            f"torch cannot share the memory of a {machine.jax_platform}",
            "use output='numpy' or output='jax'",
        )
    elif on_cpu and machine.torch_cuda:
        yield Finding(
            "problem",
            "torch uses CUDA and JAX the CPU: frames are drawn slowly and must be copied",
            _JAX_ON_CUDA,
        )
    elif on_gpu and not machine.torch_cuda:
        yield Finding(
            "problem",
            "JAX uses the GPU and torch cannot: output='torch' will not work",
            "install a torch built for CUDA, see https://pytorch.org/get-started/locally",
        )
    else:
        yield Finding("ok", "JAX and torch see the same device")


def _about_renderer(machine: Machine) -> Iterator[Finding]:
    if machine.renderer is not None:
        name, why = machine.renderer
        on_nvidia = machine.jax_platform in _GPUS and machine.has_nvidia
        level = "note" if on_nvidia and name != "pallas" else "ok"
        yield Finding(level, f"images are drawn by renderer={name!r}: {why}")


def _about_sharing(machine: Machine) -> Iterator[Finding]:
    for way, result in (("JAX to torch", machine.to_torch), ("torch to JAX", machine.to_jax)):
        if result is True:
            yield Finding("ok", f"arrays cross from {way} without a copy")
        elif result is False:
            yield Finding(
                "problem",
                f"arrays are copied on their way from {way}",
                "use a current torch and jax; the releases in constraints.txt do not copy",
            )
        elif result is not None:
            yield Finding(
                "problem",
                f"arrays do not cross from {way}: {result}",
                "mend the devices first; else use output='numpy'",
            )


def _about_memory(machine: Machine) -> Iterator[Finding]:
    environ = machine.environ
    if _FRACTION in environ and _OLD_FRACTION in environ:
        yield Finding(
            "problem",
            f"{_FRACTION} and {_OLD_FRACTION} are both set, which JAX refuses",
            f"unset {_OLD_FRACTION}",
        )
    if machine.jax_platform not in _GPUS:
        return
    # As JAX itself reads them.
    preallocates = environ.get(_PREALLOCATE) not in ("false", "False", "0")
    if environ.get(_ALLOCATOR, "default").lower() in ("platform", "cuda_async"):
        preallocates = False
    try:
        fraction = float(environ.get(_FRACTION) or environ.get(_OLD_FRACTION) or 0.75)
    except ValueError:
        fraction = 0.75
    if preallocates and fraction > 0.5 and machine.torch_cuda:
        yield Finding(
            "note",
            f"JAX takes {fraction:.0%} of the GPU's memory at its start and leaves torch the rest",
            f"export {_FRACTION}=0.4, or {_PREALLOCATE}=false, before Python starts",
        )
    elif not preallocates or fraction <= 0.5:
        yield Finding("ok", "JAX leaves GPU memory for others")


def _about_gl(machine: Machine) -> Iterator[Finding]:
    if machine.gl_libraries is None:
        yield Finding("ok", "images need no OpenGL and no display")
    elif machine.gl_libraries:
        names = ", ".join(machine.gl_libraries)
        yield Finding("note", f"images need no OpenGL, though something else has loaded {names}")
    else:
        yield Finding("ok", "images need no OpenGL and no display, and none is loaded")


def _about_variables(machine: Machine) -> Iterator[Finding]:
    for name, why in machine.broken.items():
        variable = _VARIABLES[name]
        yield Finding(
            variable.level,
            f"with {name}={machine.environ.get(name, '')}, {variable.text}: {why}",
            f"unset {name}, or mend it",
        )


def _about_cache(machine: Machine) -> Iterator[Finding]:
    if machine.cache:
        yield Finding(
            "note",
            f"clips are read anew each time, as they cannot be cached: {machine.cache}",
            "export PIXELBRAX_CACHE=<a folder that can be written>",
        )


def _broken_variables() -> dict[str, str]:
    """Try each variable that is set in a process of its own, which some of them end."""
    broken = {}
    for name, variable in _VARIABLES.items():
        if not os.environ.get(name) or _version(variable.package) is None:
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
    said = result.stderr.strip().rpartition("\n")[2][:200]
    return (said or f"exit status {result.returncode}") if result.returncode else ""


def _why_no_cache() -> str:
    try:
        folder = cache_folder().absolute()
        while not folder.exists():
            folder = folder.parent
    except OSError as error:
        return str(error)
    return "" if os.access(folder, os.W_OK) else f"{folder} cannot be written"


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


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
    """Return the OpenGL libraries in this process, after all that draws a frame was imported."""
    try:
        import pixelbrax_jax  # noqa: F401
    except Exception:  # told of elsewhere
        return None
    maps = Path("/proc/self/maps")
    if not sys.platform.startswith("linux") or not maps.exists():
        return None
    names = {Path(line.split()[-1]).name for line in maps.read_text().splitlines() if "/" in line}
    return tuple(sorted(name for name in names if name.startswith(_GL_LIBRARIES)))
