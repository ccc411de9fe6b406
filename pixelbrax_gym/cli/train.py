"""Train an agent."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    UnsupportedTypeAnnotationError,
)

from pixelbrax_gym.cli import CommandError, UsageError, say
from pixelbrax_jax.extras import needs_extra
from pixelbrax_jax.validation import check_choice, check_positive_int

if TYPE_CHECKING:
    from pixelbrax_jax.agents.config import TrainConfig
    from pixelbrax_jax.agents.runner.settings import RunConfig


@dataclass(frozen=True)
class Launch:
    """Options that start a run."""

    preset: str = "default"
    """Named settings, such as cpu; they change the defaults of all other options."""
    cpu_devices: int | None = None
    """Emulates this many devices on a CPU and distributes the environments over them; use one per
    core."""
    coordinator: str | None = None
    """HOST:PORT of process 0 in a run with several processes."""
    num_processes: int | None = None
    """Number of processes."""
    process_id: int | None = None
    """Index of this process, from 0."""

    def start(self) -> None:
        """Configure JAX's devices and processes."""
        import jax

        if self.cpu_devices is not None:
            check_positive_int("--cpu-devices", self.cpu_devices)
            try:
                jax.config.update("jax_num_cpu_devices", self.cpu_devices)
            except RuntimeError as error:
                raise ValueError(
                    f"--cpu-devices {self.cpu_devices} comes too late: JAX has already started in "
                    "this process. Start a new one."
                ) from error
        spread = (self.coordinator, self.num_processes, self.process_id)
        if None not in spread:
            jax.distributed.initialize(*spread)
        elif any(given is not None for given in spread):
            raise UsageError("--coordinator, --num-processes and --process-id belong together")


@dataclass(frozen=True)
class _First:
    """Options that select the defaults of all others."""

    preset: str = "default"
    task: str | None = None


def _first(arguments: Sequence[str]) -> _First:
    first, _ = tyro.cli(_First, args=arguments, return_unknown_args=True, add_help=False)
    return first


def run(arguments: Sequence[str]) -> int:
    """Run the command."""
    with needs_extra("train"):
        from pixelbrax_jax.agents.presets import PRESETS, check_preset
        from pixelbrax_jax.agents.registry import ALGORITHMS
        from pixelbrax_jax.agents.runner.checkpoint import CheckpointError, latest_steps
        from pixelbrax_jax.agents.runner.train import TrainingDivergedError, train
    import jax

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
            f"name an algorithm first, as in 'pixelbrax train ppo {algorithm} ...'; known "
            f"algorithms: {', '.join(ALGORITHMS)}"
        )
    try:
        check_choice("algorithm", algorithm, ALGORITHMS)
        check_preset(algorithm, _first(rest).preset)
    except ValueError as error:
        raise UsageError(str(error)) from error
    launch, config, options = parse(algorithm, rest)
    launch.start()
    try:
        outcome = train(config, options, _report)
    except (CheckpointError, TrainingDivergedError, jax.errors.JaxRuntimeError) as error:
        raise CommandError(str(error)) from error
    except KeyboardInterrupt:
        kept = "there is no checkpoint"
        if (latest := latest_steps(Path(options.output_dir) / "checkpoints")) is not None:
            kept = f"continue from the checkpoint of {latest} steps with --resume latest"
        say("train", f"stopped at once; {kept}")
        raise
    return 128 + outcome.signal if outcome.signal else 0


def _report(line: str) -> None:
    """Write a line above the progress bar."""
    import jax
    from tqdm import tqdm

    if jax.process_index() == 0:
        tqdm.write(line, file=sys.stderr)


def parse(algorithm: str, arguments: Sequence[str]) -> tuple[Launch, TrainConfig, RunConfig]:
    """Parse the options of an algorithm; raise a ValueError if a setting is out of range."""
    from pixelbrax_jax.agents.presets import preset, preset_names
    from pixelbrax_jax.agents.runner.settings import RunConfig

    # Defaults are those of a preset, which may be those of a task.
    first = _first(arguments)
    parts: dict[str, Any] = {
        "launch": Launch(first.preset),
        "config": preset(algorithm, first.preset, first.task),
        "options": RunConfig(output_dir=f"runs/{algorithm}"),
    }
    # One flat list of options for all.
    flat, hide_unparsable = tyro.conf.OmitArgPrefixes, tyro.conf.SuppressFixed
    command: Any = make_dataclass(
        "Train", [(part, flat[hide_unparsable[type(value)]]) for part, value in parts.items()]
    )
    with _names_for_objects():
        parsed = tyro.cli(
            command,
            prog=f"pixelbrax train {algorithm}",
            description=f"Trains {algorithm.upper()} from pixels; presets: "
            f"{', '.join(preset_names(algorithm))}.",
            default=command(**parts),
            args=arguments,
        )
    return parsed.launch, parsed.config, parsed.options


def _names_for_objects() -> ConstructorRegistry:
    """Return a context that parses options that may be objects in Python as names."""
    from pixelbrax_jax.config import EnvConfig

    types, registry = get_type_hints(EnvConfig), ConstructorRegistry()
    metavars = {
        types["camera"]: "NAME ...",
        types["distractors"]: "[NAME ...]",
        types["look"]: "NAME",
        types["clips"]: "FOLDER",
        types["dynamics"]: "NAME=LOW:HIGH,...",
    }

    @registry.primitive_rule
    def names(
        info: PrimitiveTypeInfo,
    ) -> PrimitiveConstructorSpec | UnsupportedTypeAnnotationError | None:
        if info.type == types["camera_sizes"]:
            return UnsupportedTypeAnnotationError(())  # agents see images of one size
        if info.type not in metavars:
            return None
        several = info.type in (types["camera"], types["distractors"])
        return PrimitiveConstructorSpec(
            nargs="*" if several else 1,
            metavar=metavars[info.type],
            instance_from_str=tuple if several else lambda args: args[0],
            is_instance=lambda value: value is None or isinstance(value, (str, tuple)),
            str_from_instance=lambda value: (
                list(value) if isinstance(value, tuple) else [str(value)]
            ),
        )

    return registry
