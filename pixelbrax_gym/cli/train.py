"""Train an agent."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from pixelbrax_gym.cli import CommandError, UsageError, needs_extra, say
from pixelbrax_jax.validation import check_choice, check_positive_int

if TYPE_CHECKING:
    from pixelbrax_jax.agents.config import TrainConfig
    from pixelbrax_jax.agents.runner.settings import RunConfig


@dataclass(frozen=True)
class First:
    """What is known before the settings: which defaults they have, and which devices there are."""

    preset: str = "default"
    """Set of defaults."""
    task: str | None = None
    """Task, which a preset may have settings for."""
    cpu_devices: int | None = None
    """Spread the environments over so many emulated devices, one a core, without an accelerator."""
    coordinator: str | None = None
    """host:port of process 0, of several processes that share the run."""
    num_processes: int | None = None
    """How many processes share the run."""
    process_id: int | None = None
    """Which of them this is, from 0."""

    def start(self) -> None:
        """Emulate devices, and join the other processes."""
        import jax

        if self.cpu_devices is not None:
            check_positive_int("--cpu-devices", self.cpu_devices)
            try:
                jax.config.update("jax_num_cpu_devices", self.cpu_devices)
            except RuntimeError as error:
                raise ValueError(
                    f"--cpu-devices {self.cpu_devices} comes too late: JAX is at work in this "
                    "process."
                ) from error
        if self.coordinator is not None:
            jax.distributed.initialize(self.coordinator, self.num_processes, self.process_id)


def run(arguments: Sequence[str]) -> int:
    """Run the command.

    Returns:
        The exit status; 128 plus its number after a signal that stopped the run.
    """
    with needs_extra("train"):
        from pixelbrax_jax.agents.on_policy.presets import PRESETS
        from pixelbrax_jax.agents.registry import ALGORITHMS
        from pixelbrax_jax.agents.runner import train
    algorithms, presets = ",".join(ALGORITHMS), ",".join(PRESETS)
    if not arguments or arguments[0] in ("-h", "--help"):
        sys.stdout.write(
            f"usage: pixelbrax train {{{algorithms}}} [--preset {{{presets}}}] [options]\n\n"
            "All options: pixelbrax train ppo --help\n"
        )
        return 0
    algorithm, *rest = arguments
    if algorithm.startswith("-"):
        raise UsageError(
            f"name an algorithm first, as in 'pixelbrax train ppo {algorithm} ...'; there are "
            f"{algorithms.replace(',', ', ')}"
        )
    first, rest = read_first(rest)
    try:
        check_choice("algorithm", algorithm, ALGORITHMS)
        check_choice("preset", first.preset, PRESETS)
    except ValueError as error:
        raise UsageError(str(error)) from error
    spread = (first.coordinator, first.num_processes, first.process_id)
    if None in spread and any(given is not None for given in spread):
        raise UsageError("--coordinator, --num-processes and --process-id belong together")
    first.start()
    config, options = settings(algorithm, first, rest)
    with _errors(options):
        outcome = train.train(config, options, _report)
        return 128 + outcome.signal if outcome.interrupted else 0


def read_first(arguments: Sequence[str]) -> tuple[First, list[str]]:
    """Return what is known before the settings, and the other arguments."""
    return tyro.cli(
        First, prog="pixelbrax train", args=arguments, return_unknown_args=True, add_help=False
    )


def settings(
    algorithm: str, first: First, arguments: Sequence[str]
) -> tuple[TrainConfig, RunConfig]:
    """Return settings of an algorithm and of the run, from options over a preset.

    Args:
        algorithm: its name.
        first: the preset, and the task that it may have settings for.
        arguments: other options, as ``--num-envs 64``.

    Raises:
        ValueError: a setting is out of range.
        SystemExit: an option is unknown.
    """
    from pixelbrax_jax.agents.on_policy.presets import PRESETS, preset
    from pixelbrax_jax.agents.runner.settings import RunConfig

    defaults = {
        "config": preset(algorithm, first.preset, first.task),
        "options": RunConfig(output_dir=f"runs/{algorithm}"),
    }
    # One flat list of options for both.
    flat: Any = tyro.conf.OmitArgPrefixes
    command: Any = make_dataclass(
        "Train", [(name, flat[type(value)]) for name, value in defaults.items()]
    )
    with _names_for_objects():
        parsed = tyro.cli(
            command,
            prog=f"pixelbrax train {algorithm}",
            description=(
                f"Trains {algorithm.upper()} from pixels. --preset {{{','.join(PRESETS)}}} changes "
                "the defaults; --cpu-devices D spreads the environments over D emulated devices, "
                "one a core, on a machine without an accelerator; --coordinator HOST:PORT "
                "--num-processes P --process-id I spreads a run over P processes."
            ),
            default=command(**defaults),
            args=[*arguments, *(["--task", first.task] if first.task else [])],
        )
    return parsed.config, parsed.options


def _names_for_objects() -> ConstructorRegistry:
    """Return a context in which options may be names that in Python may be objects."""
    from pixelbrax_jax.config import EnvConfig

    types, registry = get_type_hints(EnvConfig), ConstructorRegistry()

    @registry.primitive_rule
    def one_name(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
        if info.type not in [types[name] for name in ("camera", "look", "clips")]:
            return None
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar="FOLDER" if info.type == types["clips"] else "NAME",
            instance_from_str=lambda args: args[0],
            is_instance=lambda value: value is None or isinstance(value, str),
            str_from_instance=lambda value: [str(value)],
        )

    @registry.primitive_rule
    def several_names(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
        if info.type != types["distractors"]:
            return None
        return PrimitiveConstructorSpec(
            nargs="*",
            metavar="[NAME ...]",
            instance_from_str=tuple,
            is_instance=lambda value: isinstance(value, tuple),
            str_from_instance=list,
        )

    return registry


@contextmanager
def _errors(options: RunConfig) -> Iterator[None]:
    """Have what may end a run reported in one line."""
    import jax

    from pixelbrax_jax.agents.runner.checkpoint import CheckpointError, latest_steps
    from pixelbrax_jax.agents.runner.train import TrainingDivergedError

    try:
        yield
    except (CheckpointError, TrainingDivergedError, jax.errors.JaxRuntimeError) as error:
        raise CommandError(str(error)) from error
    except KeyboardInterrupt:
        kept = "there is no checkpoint"
        if (latest := latest_steps(Path(options.output_dir) / "checkpoints")) is not None:
            kept = f"go on from the checkpoint of {latest} steps with --resume latest"
        say("train", f"stopped at once; {kept}")
        raise


def _report(line: str) -> None:
    """Write a line of a run above the bar."""
    import jax
    from tqdm import tqdm

    if jax.process_index() == 0:
        tqdm.write(line, file=sys.stderr)
