"""Settings of a training run from the command line, and its exit status."""

from __future__ import annotations

import contextlib
import sys
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from typing import Any, get_type_hints

import jax
import tyro
from tqdm import tqdm
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
)

from pixelbrax_gym.cli import UsageError
from pixelbrax_jax.agents.config import TrainConfig
from pixelbrax_jax.agents.on_policy.presets import PRESETS, preset
from pixelbrax_jax.agents.registry import ALGORITHMS
from pixelbrax_jax.agents.runner import train as training
from pixelbrax_jax.agents.runner.checkpoint import CheckpointError, latest_steps
from pixelbrax_jax.agents.runner.settings import RunConfig
from pixelbrax_jax.config import EnvConfig
from pixelbrax_jax.validation import check_choice, check_positive_int

INTERRUPTED = 130
"""Exit status of a run that was stopped by Ctrl-C, as shells have it."""

names_for_objects = ConstructorRegistry()
"""As a context, lets ``tyro.cli`` read every field of ``EnvConfig``."""


@names_for_objects.primitive_rule
def _name(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    types = get_type_hints(EnvConfig)
    if info.type not in [types[name] for name in ("camera", "look", "clips")]:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="FOLDER" if info.type == types["clips"] else "NAME",
        instance_from_str=lambda args: args[0],
        is_instance=lambda value: value is None or isinstance(value, str),
        str_from_instance=lambda value: [str(value)],
    )


@names_for_objects.primitive_rule
def _names(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    if info.type != get_type_hints(EnvConfig)["distractors"]:
        return None
    return PrimitiveConstructorSpec(
        nargs="*",
        metavar="[NAME ...]",
        instance_from_str=tuple,
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=list,
    )


@dataclass(frozen=True)
class Launch:
    """How a run is started."""

    preset: str = "default"
    """Named settings, as cpu; they change the defaults of all others."""
    cpu_devices: int | None = None
    """Emulated devices that the environments are spread over, one a core, on a machine without an
    accelerator."""
    coordinator: str | None = None
    """HOST:PORT of process 0, of several processes."""
    num_processes: int | None = None
    """How many there are."""
    process_id: int | None = None
    """Which of them this is, from 0."""

    def start(self) -> None:
        """Make devices and processes known to JAX.

        Raises:
            UsageError: options do not go together.
            ValueError: devices cannot be emulated.
        """
        if self.cpu_devices is not None:
            _emulate(self.cpu_devices)
        spread = (self.coordinator, self.num_processes, self.process_id)
        if None not in spread:
            jax.distributed.initialize(*spread)
        elif any(given is not None for given in spread):
            raise UsageError("--coordinator, --num-processes and --process-id belong together")


def train(arguments: list[str]) -> int:
    """Run the command.

    Args:
        arguments: those behind ``pixelbrax train``.

    Returns:
        The exit status: 0 when all is well, 1 for an error, which stderr names, and for a run
        that was stopped 128 plus the signal's number, as shells have it: 130 for Ctrl-C, 143 for
        SIGTERM, 138 for SIGUSR1 on most systems.

    Raises:
        UsageError: no algorithm is named, or options do not go together.
        ValueError: a setting is out of range.
    """
    names = ",".join(ALGORITHMS)
    if not arguments or arguments[0] in ("-h", "--help"):
        sys.stdout.write(
            f"usage: pixelbrax train {{{names}}} [--preset {{{','.join(PRESETS)}}}] [options]\n\n"
            "All options: pixelbrax train ppo --help\n"
        )
        return 0
    algorithm, *rest = arguments
    if algorithm.startswith("-"):
        raise UsageError(
            f"name an algorithm first, as in 'pixelbrax train ppo {algorithm} ...'; there are "
            f"{', '.join(ALGORITHMS)}"
        )
    check_choice("algorithm", algorithm, ALGORITHMS)
    launch, config, options = parse(algorithm, rest)
    launch.start()
    try:
        outcome = training.train(config, options, _report)
        return 128 + outcome.signal if outcome.interrupted else 0
    except (
        CheckpointError,
        training.TrainingDivergedError,
        ValueError,
        OSError,
        MemoryError,
        ImportError,
        jax.errors.JaxRuntimeError,
    ) as error:
        _write(f"pixelbrax train: {error}")
        return 1
    except KeyboardInterrupt:
        latest = latest_steps(Path(options.output_dir) / "checkpoints")
        kept = "there is no checkpoint"
        if latest is not None:
            kept = f"go on from the checkpoint of {latest} steps with --resume latest"
        _write(f"pixelbrax train: stopped at once; {kept}")
        return INTERRUPTED


def _report(line: str) -> None:
    """Write a line of a run above the bar."""
    if jax.process_index() == 0:
        tqdm.write(line, file=sys.stderr)


def _write(line: str) -> None:
    """Write a line above the bar, if anybody is left to read it."""
    with contextlib.suppress(OSError, ValueError):
        tqdm.write(line, file=sys.stderr)


def _emulate(cpu_devices: int) -> None:
    """Let JAX show the CPU as several devices, each of which computes in threads of its own.

    Raises:
        ValueError: the number is below 1, or JAX is at work already.
    """
    check_positive_int("--cpu-devices", cpu_devices)
    try:
        jax.config.update("jax_num_cpu_devices", cpu_devices)
    except RuntimeError as error:
        raise ValueError(
            f"--cpu-devices {cpu_devices} comes too late: JAX is at work in this process."
        ) from error


def parse(algorithm: str, arguments: list[str]) -> tuple[Launch, TrainConfig, RunConfig]:
    """Return how to start, settings of an algorithm and of the run.

    Args:
        algorithm: its name.
        arguments: options, as ``--preset cpu --num-envs 64``.

    Raises:
        ValueError: a setting is out of range.
        SystemExit: an option is unknown.
    """
    # Defaults are those of a preset, which may be those of a task.
    first, _ = tyro.cli(_First, args=arguments, return_unknown_args=True, add_help=False)
    parts: dict[str, Any] = {
        "launch": Launch(first.preset),
        "config": preset(algorithm, first.preset, first.task),
        "options": RunConfig(output_dir=f"runs/{algorithm}"),
    }
    # One flat list of options for all.
    flat: Any = tyro.conf.OmitArgPrefixes
    command = make_dataclass("Train", [(part, flat[type(value)]) for part, value in parts.items()])
    with names_for_objects:
        parsed = tyro.cli(
            command,
            prog=f"pixelbrax train {algorithm}",
            description=f"Trains {algorithm.upper()} from pixels; presets: {', '.join(PRESETS)}.",
            default=command(**parts),
            args=arguments,
        )
    return parsed.launch, parsed.config, parsed.options


@dataclass(frozen=True)
class _First:
    preset: str = "default"
    task: str | None = None
