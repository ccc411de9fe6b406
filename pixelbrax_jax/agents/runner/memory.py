"""What a run will store, and whether it fits."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields

import jax

from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.runner.checkpoint import nbytes
from pixelbrax_jax.agents.runner.sharding import any_process, mesh_of
from pixelbrax_jax.agents.train_state import TrainState, env_axes


def check_memory(algorithm: Algorithm, template: TrainState, report: Callable[[str], None]) -> None:
    """Report what will be stored, and reject what would not fit.

    Args:
        algorithm: with its settings.
        template: ``jax.eval_shape`` of its state.
        report: gets the figures.

    Raises:
        MemoryError: it is more than ``memory_budget_gb``, or than the device has.
    """
    config = algorithm.config
    frames = config.bytes_per_iteration * template.iteration.size
    memories, total = _memories(algorithm), nbytes(template)
    parts = {field.name: nbytes(getattr(template, field.name)) for field in fields(template)}
    large = (f", {name} {n / 1e9:.2f} GB" for name, n in parts.items() if n > 0.01 * total)
    report(
        f"stored: frames of an iteration {frames / 1e9:.2f} GB, all state {total / 1e9:.2f} GB"
        + "".join(large)
    )
    # What belongs to environments is spread over the devices; the rest is the same on all.
    axes = jax.tree.leaves(env_axes(template))
    leaves = zip(jax.tree.leaves(template), axes, strict=True)
    alike = sum(nbytes(leaf) for leaf, axis in leaves if axis < 0)
    needed = alike + (frames + total - alike) / memories
    budget = config.memory_budget_gb
    limit = budget * 1e9 if budget is not None else _device_memory()
    if any_process(needed > limit):
        where = f" in each of {memories} memories" if memories > 1 else ""
        raise MemoryError(
            f"frames and state take {needed / 1e9:.2f} GB{where}, of {limit / 1e9:.2f} GB that "
            f"may be used. Lower {', '.join(config.memory_settings)} or the size of the images, or "
            "raise memory_budget_gb."
        )


def _memories(algorithm: Algorithm) -> int:
    """Return memories over which environments are spread; devices of a CPU share one."""
    mesh = mesh_of(algorithm)
    if mesh is None:
        return 1
    return jax.process_count() if jax.default_backend() == "cpu" else int(mesh.size)


def _device_memory() -> float:
    """Return bytes that JAX may use on its first device; no bound where nobody tells."""
    statistics = jax.local_devices()[0].memory_stats() or {}
    if "bytes_limit" in statistics:
        return float(statistics["bytes_limit"])
    try:
        import psutil
    except ImportError:
        return math.inf
    return float(psutil.virtual_memory().available)
