"""Measure the speed of this machine."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pixelbrax_gym.bench.tables import number, table
from pixelbrax_gym.cli import parse
from pixelbrax_jax.validation import check_choice, check_positive_int

SECONDS = 15.0
"""Duration of the comparison of adapters, without compilation."""


@dataclass(frozen=True)
class Options:
    """Measures renderer, environment and adapters of a task; a few minutes, mostly to compile."""

    task: str = "ant"
    """Name of the task."""
    num_envs: int = 100
    """Number of environments."""
    output: Path | None = None
    """File for the results as JSON, too."""


def run(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse("bench", Options, arguments)
    from pixelbrax_jax.tasks import TASKS

    check_choice("task", options.task, TASKS)
    check_positive_int("num_envs", options.num_envs)
    from pixelbrax_gym.bench import machine

    found: dict[str, Any] = {
        "machine": machine.describe(),
        "task": options.task,
        "num_envs": options.num_envs,
    }
    for name, measured in _measure(options.task, options.num_envs):
        found[name] = measured
        if options.output is not None:
            options.output.parent.mkdir(parents=True, exist_ok=True)
            options.output.write_text(json.dumps(found, indent=1) + "\n", "utf-8")
    sys.stdout.write(_page(found))
    return 0


def _measure(task: str, num_envs: int) -> Iterator[tuple[str, Any]]:
    """Measure one part after the other, and say which."""
    from pixelbrax_gym.bench import adapters, throughput

    parts = {
        "renderer": lambda: throughput.renderer(task, num_envs),
        "state": lambda: throughput.scan(task, num_envs, "state"),
        "pixels": lambda: throughput.scan(task, num_envs),
        "adapters": lambda: adapters.compare(task, num_envs, SECONDS),
    }
    for part, (name, measure) in enumerate(parts.items(), 1):
        sys.stderr.write(f"{part}/{len(parts)}  {name}: compiling and measuring\n")
        yield name, measure()


def _page(found: dict[str, Any]) -> str:
    """Return the tables, in Markdown."""
    machine = found["machine"]
    steps = {
        "frames, from link poses": found["renderer"]["frames_per_second"],
        "steps without images": found["state"]["steps_per_second"],
        "steps with images": found["pixels"]["steps_per_second"],
    }
    through = [
        (
            row["adapter"],
            row["autoreset_mode"],
            number(row["steps_per_second"]),
            f"{row['ratio']:.2f}",
            " to ".join(f"{bound:.2f}" for bound in row["interval"]),
        )
        for row in found["adapters"]
    ]
    return (
        f"{machine['device']} ({machine['processor']}, {machine['cores']} cores), "
        f"{found['task']}, {found['num_envs']} environments, 84 x 84, three frames\n\n"
        f"{table(('a compiled loop', 'per second'), [(k, number(v)) for k, v in steps.items()])}"
        "\n\nAdapters, interleaved; ratios to the JAX loop of the same autoreset mode:\n\n"
        f"{table(('adapter', 'autoreset', 'steps/s', 'ratio', 'interval'), through)}\n"
    )
