"""Compiles one program ahead of time, and tells what XLA made of it.

Runs in a process with what `environment.py` installs, under the variables of its ``AheadCase``.
"""

from __future__ import annotations

import os
import re
import shutil
import time
from pathlib import Path
from typing import Any

import jax
from jax.experimental import topologies

from pixelbrax_gym.bench.ahead.case import DUMP
from pixelbrax_gym.bench.ahead.hlo import parse
from pixelbrax_gym.bench.ahead.kernels import kernels, longest_chain, loops
from pixelbrax_gym.bench.ahead.programs import make_program
from pixelbrax_gym.bench.ahead.registers import assemble
from pixelbrax_gym.bench.ahead.targets import CARDS, LAUNCH_SECONDS, TPU_TOPOLOGY, Card
from pixelbrax_jax.compilation import compiler_options

_ASSEMBLED = 8
"""Files of kernels that are assembled, those of most code: they need the most registers."""


def gpu(
    task: str, program: str, num_envs: int, card: str = "H100", **options: Any
) -> dict[str, Any]:
    """Compile a program for an NVIDIA GPU.

    Args:
        task: the task.
        program: one of ``programs.PROGRAMS``.
        num_envs: environments.
        card: one of ``targets.CARDS``.
        **options: further ones of ``pixelbrax_jax.make``.

    Returns:
        What the table shows. Bytes read and written count every kernel's operands and results
        once; ``large_kernels`` are those that write at least a tenth of the output;
        ``host_steps`` is what the host does one after the other: 1 is one CUDA graph.
    """
    try:
        return _gpu(CARDS[card], *make_program(program, task, num_envs, **options))
    finally:
        if folder := os.environ.get(DUMP):
            shutil.rmtree(folder, ignore_errors=True)


def _gpu(about: Card, function: Any, arguments: Any) -> dict[str, Any]:
    topology = topologies.get_topology_desc(
        platform="cuda", target_config=about.target_config(), topology="1x1x1"
    )
    # Pallas of jax 0.12 asks what it compiles for where there is no GPU.
    device = jax.sharding.AbstractDevice(about.kind, about.cores, "gpu")
    mesh = jax.sharding.AbstractMesh((), (), abstract_device=device)
    with jax.sharding.use_abstract_mesh(mesh):
        compiled, seconds = _compile(topology, "cuda", function, arguments)
    parsed = parse(compiled.as_text())
    memory = compiled.memory_analysis()
    found = kernels(parsed)
    launches = sum(kernel.launches for kernel in found)
    read, written = (
        sum(kernel.launches * getattr(kernel, name) for kernel in found)
        for name in ("read", "written")
    )
    large = [k for k in found if k.written >= 0.1 * memory.output_size_in_bytes]
    return {
        "kernels": len(found),
        "launches": launches,
        "longest_chain": longest_chain(parsed),
        "unknown_loops": sum(loop.trips is None for loop in loops(parsed)),
        "large_kernels": sum(kernel.launches for kernel in large),
        "temporary_bytes": memory.temp_size_in_bytes,
        "output_bytes": memory.output_size_in_bytes,
        "argument_bytes": memory.argument_size_in_bytes,
        "read_bytes": read,
        "written_bytes": written,
        "host_steps": _host_steps(),
        "compile_seconds": seconds,
        "model_seconds": {
            "memory": (read + written) / about.bandwidth,
            "graph": sum(
                k.launches * max((k.read + k.written) / about.bandwidth, LAUNCH_SECONDS)
                for k in found
            ),
        },
        **_registers(about),
    }


def tpu(task: str, program: str, num_envs: int, **options: Any) -> dict[str, Any]:
    """Compile a program for a TPU v5e; see ``gpu``. Seconds and bytes are XLA's own estimates."""
    topology = topologies.get_topology_desc(platform="tpu", topology_name=TPU_TOPOLOGY)
    compiled, seconds = _compile(topology, "tpu", *make_program(program, task, num_envs, **options))
    memory, cost = compiled.memory_analysis(), compiled.cost_analysis() or {}
    estimate = cost.get("optimal_seconds", -1.0)
    return {
        "temporary_bytes": memory.temp_size_in_bytes,
        "output_bytes": memory.output_size_in_bytes,
        "accessed_bytes": cost.get("bytes accessed"),
        "compile_seconds": seconds,
        # Less than 0 where XLA has no estimate of some operation.
        "model_seconds": {"xla": estimate if estimate >= 0 else None},
    }


def _compile(topology: Any, platform: str, function: Any, arguments: Any) -> tuple[Any, float]:
    where = jax.sharding.SingleDeviceSharding(topology.devices[0])

    def ahead(*args: Any) -> Any:
        return function(*args)

    started = time.perf_counter()
    traced = jax.jit(ahead, in_shardings=where, out_shardings=where).trace(*arguments)
    lowered = traced.lower(lowering_platforms=(platform,))
    compiled = lowered.compile(compiler_options(platform=platform))
    return compiled, round(time.perf_counter() - started, 1)


def _dumped(ending: str) -> list[Path]:
    """Return what XLA wrote of the program, by name; nothing without a folder for it."""
    folder = os.environ.get(DUMP)
    return sorted(Path(folder).glob(f"*jit_ahead*.{ending}")) if folder else []


def _host_steps() -> int | None:
    """Return how many parts the host launches one after the other; None if XLA does not tell."""
    files = _dumped("thunk_sequence_after_thunk_passes.txt")
    if not files:
        return None
    return len(re.findall(r"^\d+: k\w+", files[-1].read_text("utf-8"), re.M))


def _registers(card: Card) -> dict[str, int | None]:
    sources = sorted(_dumped("ptx"), key=lambda file: -file.stat().st_size)
    most = assemble(sources[:_ASSEMBLED], card.architecture)
    return dict(most) if most else {"registers": None, "spilled": None}
