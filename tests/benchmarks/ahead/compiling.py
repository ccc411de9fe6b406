"""Compiles one program ahead of time, and tells what XLA made of it.

Runs in a process under the variables of its ``AheadCase``.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import topologies

import pixelbrax_jax as pb
from pixelbrax_jax import agents
from pixelbrax_jax.agents.config import make_env
from pixelbrax_jax.agents.registry import make_algorithm
from pixelbrax_jax.agents.train_state import TrainState
from pixelbrax_jax.compilation import compiler_options
from pixelbrax_jax.validation import check_choice
from tests.benchmarks.ahead.case import DUMP, PROGRAMS
from tests.benchmarks.ahead.hlo import kernels, longest_chain, loops, parse
from tests.benchmarks.ahead.targets import CARDS, LAUNCH_SECONDS, TPU_TOPOLOGY, Card

_ASSEMBLED = 8
"""Files of kernels that are assembled."""
SCAN_LENGTH = 16
_USED = re.compile(
    r"(\d+) bytes spill stores, (\d+) bytes spill loads.*?Used (\d+) registers", re.S
)


def gpu(
    task: str, program: str, num_envs: int, card: str = "H100", **options: Any
) -> dict[str, Any]:
    """Compile a program for an NVIDIA GPU.

    Bytes read and written count every kernel's operands and results once; ``large_kernels`` are
    those that write at least a tenth of the output; ``host_steps`` is what the host does one after
    the other: 1 is one CUDA graph.
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
        "unknown_loops": loops(parsed).count(None),
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
        **assemble(_dumped("ptx"), about.architecture),
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
    # An iteration of training reuses the memory of the state, as the runner has it.
    donated = (0,) if isinstance(arguments[0], TrainState) else ()
    traced = jax.jit(ahead, in_shardings=where, out_shardings=where, donate_argnums=donated).trace(
        *arguments
    )
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


def make_program(
    name: str, task: str, num_envs: int, **options: Any
) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """One of ``PROGRAMS`` or an ``iteration`` of training, with the shapes of its arguments."""
    check_choice("program", name, (*PROGRAMS, "iteration"))
    if name == "iteration":
        return _iteration(task=task, num_envs=num_envs, **options)
    obs_mode = "state" if name == "state step" else "pixels"
    if name == "plain renderer":
        options = {"renderer": "fused", **options}
    env, params = pb.make(task, obs_mode=obs_mode, **options)
    envs = pb.VectorPixelEnv(env, num_envs)
    state, _ = jax.eval_shape(envs.reset, jax.eval_shape(lambda: jax.random.key(0)), params)
    params = _shapes(params)
    action = jax.ShapeDtypeStruct((num_envs, env.action_size), jnp.float32)
    if name.endswith("renderer"):
        return jax.vmap(env.draw, in_axes=(0, None)), (state.sim, params)
    if name != "scan":
        return envs.step, (state, action, params)

    def scan(state: Any, x: jax.Array, p: Any) -> Any:
        def step(state: Any, _: None) -> tuple[Any, jax.Array]:
            state, timestep = envs.step(state, x, p)
            return state, timestep.reward

        return jax.lax.scan(step, state, None, length=SCAN_LENGTH)

    return scan, (state, action, params)


def _iteration(
    algorithm: str, preset: str, **changes: Any
) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """An iteration of training with an algorithm's preset, and the shapes of its arguments."""
    config = agents.preset(algorithm, preset, **changes)
    env, params = make_env(config)
    made = make_algorithm(config, pb.VectorPixelEnv(env, config.num_envs))
    state = jax.eval_shape(made.init, jax.eval_shape(lambda: jax.random.key(0)), params)
    return made.iterate, (state, _shapes(params))


def _shapes(tree: Any) -> Any:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.asarray(x).dtype), tree)


def find_assembler() -> str | None:
    """Return the path of ``ptxas`` of the wheel ``nvidia-cuda-nvcc-cu12`` or of the system."""
    try:
        spec = find_spec("nvidia.cuda_nvcc")
    except ModuleNotFoundError:
        spec = None
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        found = Path(folder) / "bin" / "ptxas"
        if found.exists():
            # pip unpacks programs of wheels without the right to run them into a target folder.
            found.chmod(0o755)
            return str(found)
    return shutil.which("ptxas")


def assemble(sources: list[Path], architecture: str) -> dict[str, int | None]:
    """The registers of the kernel that needs most, and the bytes of the one that spills most.

    None where there is no assembler that takes these kernels.
    """
    assembler, found = find_assembler(), []
    # Those of most code need the most registers.
    largest = sorted(sources, key=lambda file: -file.stat().st_size)[:_ASSEMBLED]
    for source in largest if assembler else ():
        command = [str(assembler), "-v", f"-arch={architecture}", "-o", "/dev/null", str(source)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            return {"registers": None, "spilled": None}
        found += [tuple(map(int, kernel)) for kernel in _USED.findall(done.stderr)]
    return {
        "registers": max((registers for *_, registers in found), default=None),
        "spilled": max((stores + loads for stores, loads, _ in found), default=None),
    }
