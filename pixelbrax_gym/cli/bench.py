"""Measure the speed of this machine."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from pixelbrax_gym.bench.tables import COMPARED, compared, number, table
from pixelbrax_gym.cli import CommandError, parse
from pixelbrax_jax.paths import make_file
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
    # JAX and PyTorch take turns on the same cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    import jax

    from pixelbrax_jax.tasks import TASKS

    check_choice("task", options.task, TASKS)
    check_positive_int("num_envs", options.num_envs)
    if options.output is not None:
        options = replace(options, output=make_file("--output", options.output))
    try:
        _measure(options)
    except jax.errors.JaxRuntimeError as error:
        raise CommandError(f"{error}; if memory ran out, lower --num-envs") from error
    return 0


def _measure(options: Options) -> None:
    """Measure one part after the other; print and write each as soon as it is known."""
    from pixelbrax_gym.bench import adapters, machine, throughput

    task, num_envs = options.task, options.num_envs
    here = machine.describe()
    _say(
        f"{here['device']} ({here['processor']}, {here['cores']} cores), {task}, "
        f"{num_envs} environments, 84 x 84, three frames\n"
    )
    found: dict[str, Any] = {"machine": here, "task": task, "num_envs": num_envs}
    scan_state = partial(throughput.scan, obs_mode="state")
    measures: dict[str, tuple[str, Callable[..., dict[str, Any]]]] = {
        "frames_per_second": ("frames, from link poses", throughput.renderer),
        "state_steps_per_second": ("steps without images, a compiled loop", scan_state),
        "steps_per_second": ("steps with images, a compiled loop", throughput.scan),
    }
    for key, (name, measure) in measures.items():
        found[key] = measure(task, num_envs)[key.removeprefix("state_")]
        _write(options.output, found)
        _say(f"{name:<40}{number(found[key]):>9} a second")
    found["adapters"] = adapters.compare(task, num_envs, SECONDS)
    _write(options.output, found)
    lines = [(row["adapter"], row["autoreset_mode"], *compared(row)) for row in found["adapters"]]
    _say("\nAdapters, interleaved; ratios to the JAX loop of the same autoreset mode:\n")
    _say(table(("adapter", "autoreset", *COMPARED), lines))


def _write(file: Path | None, found: dict[str, Any]) -> None:
    if file is not None:
        file.write_text(json.dumps(found, indent=1) + "\n", "utf-8")


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()
