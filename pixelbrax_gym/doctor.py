"""Check that JAX and PyTorch work together on this machine, and suggest fixes."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import import_module, metadata
from pathlib import Path
from typing import Any, NamedTuple

from packaging.requirements import Requirement

from pixelbrax_gym.bench.machine import PACKAGES, installed_version
from pixelbrax_jax.cache import cache_folder
from pixelbrax_jax.extras import install_extra
from pixelbrax_jax.processor import name_cpu

EXTRAS = {
    "torch": "torch",
    "torchrl": "torchrl",
    "sb3": "stable-baselines3",
    "dmc": "dm-control",
    "train": "orbax-checkpoint",
    "clips": "imageio-ffmpeg",
    "video": "moviepy",
    "human": "pygame",
    "dataset": "minari",
}
"""Extra -> its package whose version is shown."""

_JAX_ON_CUDA = install_extra("cuda12", "cuda13")
_GPUS = ("gpu", "cuda", "rocm")
_FRACTIONS = ("XLA_CLIENT_MEM_FRACTION", "XLA_PYTHON_CLIENT_MEM_FRACTION")
"""Current and old variable for JAX's share of GPU memory."""
_PATIENCE = 120.0  # seconds; a GPU driver may take tens of seconds to start


class _Variable(NamedTuple):
    """An environment variable that other tools may have set."""

    package: str  # reads the variable
    code: str  # fails if the value breaks the package
    level: str  # as in Finding
    effect: str  # describes what fails


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
        "matplotlib cannot be imported; PixelBrax's plots ignore the variable",
    ),
}


@dataclass(frozen=True)
class Machine:
    """Facts about a machine, as ``inspect`` collects them."""

    versions: dict[str, str | None]  # package -> installed version, or None
    missing: dict[str, list[str]]  # extra -> its packages that are not installed, if any
    jax_device: str | None  # JAX's default device, such as cuda:0
    jax_platform: str | None  # cpu, gpu, tpu, ...
    jax_error: str | None  # why JAX has no device
    has_nvidia: bool  # whether the system has an NVIDIA GPU
    # Whether torch can use CUDA, and whether arrays become tensors, and tensors arrays, without a
    # copy; or the error; None without torch.
    torch_cuda: bool | str | None
    to_torch: bool | str | None
    to_jax: bool | str | None
    renderer: tuple[str, str] | None  # what renderer="auto" selects, and why; None without a device
    environ: dict[str, str]
    broken: dict[str, str]  # name in VARIABLES -> the error that its value causes
    cache: str  # why the cache cannot be written; empty if it can


class Finding(NamedTuple):
    """An entry of the report: a ``note`` works, but can be improved; ``fix`` may be empty."""

    level: str
    text: str
    fix: str = ""


_ok, _note, _problem = (partial(Finding, level) for level in ("ok", "note", "problem"))


def diagnose(machine: Machine) -> list[Finding]:
    """Return the findings for a machine, the most basic first."""
    return list(_findings(machine))


def _findings(m: Machine) -> Iterator[Finding]:
    yield _ok(f"{platform.platform()}, {name_cpu()}")
    here = ", ".join(f"{name} {release}" for name, release in m.versions.items() if release)
    yield _ok(f"Python {platform.python_version()}, {here}")
    if m.missing:
        each = [f"{extra} lacks {', '.join(names)}" for extra, names in m.missing.items()]
        yield _note(f"extras: {'; '.join(each)}", f"optional: {install_extra(','.join(m.missing))}")

    on_cpu, on_gpu = m.jax_platform == "cpu", m.jax_platform in _GPUS
    if m.jax_error is None:
        yield _ok(f"JAX computes on {m.jax_device}")
        if on_cpu and m.has_nvidia:
            yield _problem(
                "there is an NVIDIA GPU, but JAX does not use it",
                f"{_JAX_ON_CUDA} (nvidia-smi shows the CUDA version), unset JAX_PLATFORMS, and "
                "import jax before torch, because torch's CUDA libraries may hide JAX's",
            )
        yield from _about_torch(m, on_cpu, on_gpu)
    elif "XLA_FLAGS" not in m.broken:
        platforms = m.environ.get("JAX_PLATFORMS")
        yield _problem(
            f"JAX finds no device to compute on: {m.jax_error}"
            + (f" (JAX_PLATFORMS={platforms})" if platforms else ""),
            f"unset JAX_PLATFORMS, or install the jax that matches your driver: {_JAX_ON_CUDA}",
        )
    if m.renderer is not None:
        name, why = m.renderer
        unexpected = on_gpu and m.has_nvidia and name != "pallas"
        yield (_note if unexpected else _ok)(f"images are rendered by renderer={name!r}: {why}")

    for way, result in (("JAX to torch", m.to_torch), ("torch to JAX", m.to_jax)):
        if result is True:
            yield _ok(f"arrays pass from {way} without a copy")
        elif result is False:
            yield _problem(
                f"arrays are copied from {way}",
                "install current versions of torch and jax, such as those in constraints.txt",
            )
        elif result is not None:
            yield _problem(
                f"arrays cannot pass from {way}: {result}",
                "fix the problems with devices above, or use output='numpy'",
            )

    new, old = _FRACTIONS
    if new in m.environ and old in m.environ:
        yield _problem(f"{new} and {old} are both set, which is an error in JAX", f"unset {old}")
    share = _memory_share(m.environ)
    if on_gpu and share <= 0.5:
        yield _ok("JAX leaves GPU memory for other libraries")
    elif on_gpu and m.torch_cuda is True:
        yield _note(
            f"JAX reserves {share:.0%} of the GPU's memory when it starts; torch gets the rest",
            f"export {new}=0.4, or XLA_PYTHON_CLIENT_PREALLOCATE=false, before Python starts",
        )

    for name, why in m.broken.items():
        level, effect = VARIABLES[name].level, VARIABLES[name].effect
        text = f"with {name}={m.environ.get(name, '')}, {effect}: {why}"
        yield Finding(level, text, f"unset {name}, or correct its value")
    if m.cache:
        yield _note(
            f"clips cannot be cached, so every run reads them again: {m.cache}",
            "export PIXELBRAX_CACHE=<a writable folder>",
        )


def _about_torch(m: Machine, on_cpu: bool, on_gpu: bool) -> Iterator[Finding]:
    site = "https://pytorch.org/get-started/locally"
    if isinstance(m.torch_cuda, str):
        text = f"torch is installed but cannot be imported: {m.torch_cuda}"
        yield _problem(text, f"reinstall it, see {site}")
    elif m.torch_cuda is None:
        return
    elif not on_cpu and not on_gpu:
        text = f"torch cannot share the memory of a {m.jax_platform}"
        yield _note(text, "use output='numpy' or output='jax'")
    elif on_cpu and m.torch_cuda:
        text = "torch uses CUDA but JAX uses the CPU: rendering is slow and frames must be copied"
        yield _problem(text, _JAX_ON_CUDA)
    elif on_gpu and not m.torch_cuda:
        text = "JAX uses the GPU but torch cannot: output='torch' will not work"
        yield _problem(text, f"install a torch built for CUDA, see {site}")
    else:
        yield _ok("JAX and torch see the same device")


def _memory_share(environ: Mapping[str, str]) -> float:
    """Return the fraction of GPU memory that JAX reserves when it starts."""
    allocator = environ.get("XLA_PYTHON_CLIENT_ALLOCATOR", "").lower()
    as_needed = environ.get("XLA_PYTHON_CLIENT_PREALLOCATE") in ("false", "False", "0")
    if as_needed or allocator in ("platform", "cuda_async"):
        return 0.0
    try:
        return float(environ.get(_FRACTIONS[0]) or environ.get(_FRACTIONS[1]) or 0.75)
    except ValueError:
        return 0.75


def report(findings: list[Finding]) -> str:
    """Format the findings for a terminal."""
    lines = []
    for finding in findings:
        lines.append(f"{finding.level:>8}  {finding.text}")
        if finding.fix:
            lines.append(f"{'':>8}  -> {finding.fix}")
    problems = sum(finding.level == "problem" for finding in findings)
    end = f"{problems or 'No'} problem{'' if problems == 1 else 's'} found."
    return "\n".join([*lines, "", end])


def missing_packages(extra: str) -> list[str]:
    """Return the packages of an extra that are not installed, by PixelBrax's own metadata."""
    found = []
    for requirement in map(Requirement, metadata.requires("pixelbrax") or ()):
        marker, name = requirement.marker, requirement.name
        of_extra = (
            marker and marker.evaluate({"extra": extra}) and not marker.evaluate({"extra": ""})
        )
        if of_extra and installed_version(name) is None:
            found.append(name)
    return found


def inspect() -> Machine:
    """Inspect this machine; starts JAX and takes a second or two."""
    versions = {name: installed_version(name) for name in (*PACKAGES, *EXTRAS.values())}
    broken = broken_variables()
    # XLA would abort this process because of its flags.
    first: Any = broken.get("XLA_FLAGS") or _attempt(lambda: import_module("jax").devices()[0])
    renderer = torch_cuda = to_torch = to_jax = None
    has_jax = not isinstance(first, str)
    if has_jax and isinstance(renderer := _attempt(_renderer), str):
        renderer = "unknown", f"its check fails with {renderer}"
    if versions["torch"] is not None:
        torch_cuda = _attempt(lambda: import_module("torch").cuda.is_available())
        if has_jax and first.platform in ("cpu", *_GPUS) and not isinstance(torch_cuda, str):
            to_torch, to_jax = _attempt(_shares_to_torch), _attempt(_shares_to_jax)
    return Machine(
        versions=versions,
        missing={extra: names for extra in EXTRAS if (names := missing_packages(extra))},
        jax_device=str(first) if has_jax else None,
        jax_platform=first.platform if has_jax else None,
        jax_error=None if has_jax else first,
        has_nvidia=Path("/proc/driver/nvidia/version").exists(),
        torch_cuda=torch_cuda,
        to_torch=to_torch,
        to_jax=to_jax,
        renderer=renderer,
        environ=dict(os.environ),
        broken=broken,
        cache=why_no_cache(),
    )


def broken_variables() -> dict[str, str]:
    """Test each variable that is set, in a separate process because some values abort it."""
    broken = {}
    for name, variable in VARIABLES.items():
        if not os.environ.get(name) or installed_version(variable.package) is None:
            continue
        without = {key: value for key, value in os.environ.items() if key != name}
        why = _why_it_fails(variable.code, dict(os.environ))
        # An error that also occurs without the variable has another cause.
        if why and why != _why_it_fails(variable.code, without):
            broken[name] = why
    return broken


def _why_it_fails(code: str, environ: dict[str, str]) -> str:
    """Return the last line of a program's error; empty if it succeeds."""
    command = [sys.executable, "-c", code]
    try:
        result = subprocess.run(
            command, env=environ, capture_output=True, text=True, check=False, timeout=_PATIENCE
        )
    except subprocess.TimeoutExpired:
        return f"timeout after {_PATIENCE:.0f} s"
    last = result.stderr.strip().rpartition("\n")[2][:200]
    return (last or f"exit status {result.returncode}") if result.returncode else ""


def why_no_cache() -> str:
    """Return why the cache cannot be written; empty if it can."""
    try:
        folder = cache_folder().absolute()
        while not folder.exists():
            folder = folder.parent
    except OSError as error:
        return str(error)
    if not folder.is_dir():
        return f"{folder} is no folder"
    return "" if os.access(folder, os.W_OK | os.X_OK) else f"{folder} cannot be written"


def _attempt(check: Callable[[], Any]) -> Any:
    """Return the result of a check, or its error as text."""
    try:
        return check()
    except Exception as error:  # Any error is reported, not raised.
        return f"{type(error).__name__}: {error}"


def _renderer() -> tuple[str, str]:
    from pixelbrax_jax.renderer.choice import auto_renderer

    return auto_renderer()


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

    # A large tensor, because allocators align large memory.
    tensor = torch.zeros(1 << 16, device=default_torch_device())
    array = jax.block_until_ready(jax.dlpack.from_dlpack(tensor))
    return bool(array.unsafe_buffer_pointer() == tensor.data_ptr())
