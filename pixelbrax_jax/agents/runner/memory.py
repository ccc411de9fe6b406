"""What a run will store, and whether it fits."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax

from pixelbrax_jax._platform.lowering import default_platform
from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.runner.checkpoint import nbytes
from pixelbrax_jax.agents.runner.sharding import any_process, mesh_of
from pixelbrax_jax.agents.train_state import TrainState


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
    frame = config.num_envs * config.env.height * config.env.width * 3
    rollout = frame * (config.num_steps + config.env.frame_stack - 1) * template.iteration.size
    buffer, parts = nbytes(template.buffer), _memories(algorithm)
    # What belongs to environments is spread over the devices; the rest is the same on all.
    alike = nbytes((template.networks, template.opt_state, template.aux_opt_state))
    stored = alike + (rollout + nbytes(template) - alike) / parts
    report(
        f"stored: rollout {rollout / 1e9:.2f} GB, auxiliary buffer {buffer / 1e9:.2f} GB, all "
        f"state {nbytes(template) / 1e9:.2f} GB"
    )
    budget = config.memory_budget_gb
    limit = budget * 1e9 if budget is not None else _device_memory()
    if any_process(stored > limit):
        where = f" in each of {parts} memories" if parts > 1 else ""
        raise MemoryError(
            f"rollout and state take {stored / 1e9:.2f} GB{where}, of {limit / 1e9:.2f} GB that "
            f"may be used. Lower num_envs, num_steps{', num_policy_phases' if buffer else ''} or "
            "the size of the images, or raise memory_budget_gb."
        )


def _memories(algorithm: Algorithm) -> int:
    """Return memories over which environments are spread; devices of a CPU share one."""
    mesh = mesh_of(algorithm)
    if mesh is None:
        return 1
    return jax.process_count() if default_platform() == "cpu" else int(mesh.size)


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
