"""Settings of a training run from the command line, and its exit status."""

from __future__ import annotations

import argparse
import contextlib
import sys
from dataclasses import make_dataclass
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

from pixelbrax_jax.agents.config import TrainConfig
from pixelbrax_jax.agents.on_policy.presets import PRESETS, preset
from pixelbrax_jax.agents.registry import ALGORITHMS
from pixelbrax_jax.agents.runner import train as training
from pixelbrax_jax.agents.runner.checkpoint import CheckpointError, latest_steps
from pixelbrax_jax.agents.runner.settings import RunConfig
from pixelbrax_jax.config import EnvConfig
from pixelbrax_jax.validation import check_positive_int

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


def train(arguments: list[str]) -> int:
    """Run the command.

    Args:
        arguments: those behind ``pixelbrax train``.

    Returns:
        The exit status: 0 when all is well, 1 for an error, which stderr names, and for a run
        that was stopped 128 plus the signal's number, as shells have it: 130 for Ctrl-C, 143 for
        SIGTERM, 138 for SIGUSR1 on most systems.
    """
    first = argparse.ArgumentParser(
        prog="pixelbrax train", add_help=False, usage="pixelbrax train ALGORITHM [options]"
    )
    first.add_argument("algorithm", choices=sorted(ALGORITHMS))
    first.add_argument("--preset", choices=sorted(PRESETS), default="default")
    first.add_argument("--coordinator", help="host:port of process 0, of several processes")
    first.add_argument("--num-processes", type=int)
    first.add_argument("--process-id", type=int)
    first.add_argument("--cpu-devices", type=int)
    if not arguments or arguments[0] in ("-h", "--help"):
        sys.stdout.write(
            "usage: pixelbrax train {"
            + ",".join(ALGORITHMS)
            + "} [--preset {"
            + ",".join(PRESETS)
            + "}] [options]\n\nAll options: pixelbrax train ppo --help\n"
        )
        return 0
    if arguments[0].startswith("-"):
        first.error(
            f"name an algorithm first, as in 'pixelbrax train ppo {arguments[0]} ...'; there are "
            f"{', '.join(ALGORITHMS)}"
        )
    chosen, rest = first.parse_known_args(arguments)
    spread = (chosen.coordinator, chosen.num_processes, chosen.process_id)
    if None in spread and any(given is not None for given in spread):
        first.error("--coordinator, --num-processes and --process-id belong together")
    options = None
    try:
        if chosen.cpu_devices is not None:
            _emulate(chosen.cpu_devices)
        if chosen.coordinator is not None:
            jax.distributed.initialize(*spread)
        config, options = parse(chosen.algorithm, chosen.preset, rest)
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
        folder = Path(options.output_dir) / "checkpoints" if options else None
        latest = None if folder is None else latest_steps(folder)
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


def parse(algorithm: str, name: str, arguments: list[str]) -> tuple[TrainConfig, RunConfig]:
    """Return settings of an algorithm and of the run, from options over a preset.

    Args:
        algorithm: its name.
        name: of the preset.
        arguments: options, as ``--num-envs 64``.

    Raises:
        ValueError: a setting is out of range.
        SystemExit: an option is unknown.
    """
    # A preset's settings may be those of a task.
    task = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    task.add_argument("--task")
    defaults = preset(algorithm, name, task.parse_known_args(arguments)[0].task)
    options = RunConfig(output_dir=f"runs/{algorithm}")
    # One flat list of options for both.
    parts: dict[str, Any] = {"config": defaults, "options": options}
    flat: Any = tyro.conf.OmitArgPrefixes
    kinds = [(part, flat[type(value)]) for part, value in parts.items()]
    command = make_dataclass("Train", kinds)
    description = (
        f"Trains {algorithm.upper()} from pixels. --preset {{{','.join(PRESETS)}}} changes the "
        "defaults; --cpu-devices D spreads the environments over D emulated devices, one a core, "
        "on a machine without an accelerator; --coordinator HOST:PORT --num-processes P "
        "--process-id I spreads a run over P processes."
    )
    with names_for_objects:
        parsed = tyro.cli(
            command,
            prog=f"pixelbrax train {algorithm}",
            description=description,
            default=command(**parts),
            args=arguments,
        )
    return parsed.config, parsed.options
