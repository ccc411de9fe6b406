"""The command ``pixelbrax``."""

from __future__ import annotations

import argparse
import signal
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pixelbrax_jax.extras import install_extra
from pixelbrax_jax.tasks import TASKS


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        arguments: of the command line; None means those of this process.

    Returns:
        The exit status, 0 when all is well.
    """
    parser = argparse.ArgumentParser(
        prog="pixelbrax", description="Continuous control from pixels, on JAX."
    )
    parser.add_argument("--version", action="version", version=_version())
    commands = parser.add_subparsers(title="commands", required=True)
    command = commands.add_parser(
        "doctor",
        help="tell whether JAX and PyTorch work together here, and fix what does not",
        description="Tells whether JAX and PyTorch see the same device, whether frames cross "
        "between them without a copy, and how to fix what is amiss. Exits with 1 if something "
        "is.",
    )
    command.set_defaults(run=_doctor)
    command = commands.add_parser("tasks", help="list the tasks", description="Lists the tasks.")
    command.set_defaults(run=_tasks)
    _add_play(commands)
    _add_clips(commands)
    # Its options are the fields of the settings' classes, which tyro reads by itself.
    commands.add_parser("train", help="train an agent: train ppo --help", add_help=False)
    _add_evaluate(commands)
    _add_record(commands)
    commands.add_parser("bench", help="measure this machine: bench --help", add_help=False)
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    _find_modules_here()
    if arguments[:1] == ["train"]:
        return _train(arguments[1:])
    if arguments[:1] == ["bench"]:
        return _bench(arguments[1:])
    options = parser.parse_args(arguments)
    return int(options.run(options))


def _find_modules_here() -> None:
    """Let modules with tasks of the user's be found in the current folder, as `python -m` does.

    It comes last, so that no file in it hides a library.
    """
    with suppress(OSError):  # the folder is deleted
        if not {"", (here := str(Path.cwd()))}.intersection(sys.path):
            sys.path.append(here)


def _tasks(options: argparse.Namespace) -> int:
    del options
    width = max(map(len, TASKS))
    for name, row in TASKS.items():
        sys.stdout.write(f"{name:{width}}  {row.gymnasium_id}: {row.summary}\n")
    if find_spec("dm_control") is None:
        sys.stderr.write(
            f"pixelbrax tasks: those named dmc need dm_control: {install_extra('dmc')}\n"
        )
    return 0


def _add_play(commands: Any) -> None:
    command = commands.add_parser(
        "play",
        help="see a task as an agent sees it",
        description="Plays a task in a window, or, with --gif or where there is no display, into "
        "an animated image.",
    )
    command.add_argument(
        "task",
        help="as ant; 'pixelbrax tasks' lists them; or MODULE:NAME, which imports the module first",
    )
    command.add_argument(
        "--policy",
        choices=("random", "zero", "pretrained"),
        default="random",
        help="who acts; pretrained comes with the package for some tasks (default: random)",
    )
    command.add_argument("--backend", help="of the physics")
    command.add_argument("--camera", help="as top; an unknown one lists those of the task")
    command.add_argument("--look", help="default, original or dmc")
    command.add_argument("--shadows", action="store_true", default=None)
    command.add_argument("--distractors", nargs="+", help="such as dcs-easy, or paper-color")
    command.add_argument("--clips", help="of videos: procedural, or a folder")
    command.add_argument("--split", help="of the clips: train, test, ...")
    command.add_argument(
        "--observation", action="store_true", help="show the observation's own pixels, enlarged"
    )
    command.add_argument("--size", type=int, default=336, help="pixels, square (default: 336)")
    command.add_argument("--seed", type=int, default=0, help="of the episodes (default: 0)")
    command.add_argument("--gif", metavar="FILE", help="write a .gif or an .mp4, and no window")
    command.add_argument("--num-frames", type=int, default=200, help="of the file (default: 200)")
    command.set_defaults(run=_play)


def _play(options: argparse.Namespace) -> int:
    try:
        from pixelbrax_gym.play import play
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    return play(options)


def _add_clips(commands: Any) -> None:
    command = commands.add_parser(
        "clips",
        help="prepare the videos of a distractor, and show them",
        description="Reads and caches the clips of a folder (DAVIS-2017, video files or folders "
        "of images), or makes procedural ones, and tells what there is.",
    )
    command.add_argument("source", help="a folder, or 'procedural'")
    command.add_argument("--split", default="train", help="train, test, ... (default: train)")
    command.add_argument("--size", type=int, default=84, help="pixels, square (default: 84)")
    command.add_argument("--num-clips", type=int, help="only the first ones")
    command.add_argument("--cache-dir", help="default: $PIXELBRAX_CACHE or ~/.cache/pixelbrax")
    command.add_argument("--sheet", help="write a contact sheet to this image file")
    command.set_defaults(run=_clips)


def _clips(options: argparse.Namespace) -> int:
    from pixelbrax_jax.distractors.clips import load_clips
    from pixelbrax_jax.distractors.contact_sheet import check_image, contact_sheet

    def tell(message: Warning | str, *_: Any, **__: Any) -> None:
        sys.stderr.write(f"pixelbrax clips: {message}\n")

    try:
        if options.sheet:
            check_image(options.sheet)
        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = tell
            bank = load_clips(
                options.source,
                options.split,
                height=options.size,
                width=options.size,
                num_clips=options.num_clips,
                cache_dir=options.cache_dir,
            )
        if options.sheet:
            contact_sheet(bank).save(options.sheet)
    except (OSError, ValueError, MemoryError, ImportError) as error:
        sys.stderr.write(f"pixelbrax clips: {error}\n")
        return 1
    for name, length in zip(bank.names, bank.length, strict=True):
        sys.stdout.write(f"{int(length):6d}  {name}\n")
    sys.stdout.write(
        f"{len(bank.names)} clips, {len(bank.frames)} frames of {options.size} x {options.size} "
        f"pixels, {bank.device_bytes / 1e6:.1f} MB on the device\n"
    )
    if options.sheet:
        sys.stdout.write(f"contact sheet in {options.sheet}\n")
    return 0


def _train(arguments: list[str]) -> int:
    try:
        from pixelbrax_jax.agents.runner.train_command import train
    except ImportError as error:
        return _lacks_train("train", error)
    except KeyboardInterrupt:
        # While packages are imported, before a run has anything to lose.
        return 128 + signal.SIGINT
    return train(arguments)


def _lacks_train(command: str, error: ImportError) -> int:
    """Say how to get the extra that agents need, and return the exit status."""
    sys.stderr.write(f"pixelbrax {command}: {error}; try: {install_extra('train')}\n")
    return 1


def _add_trained(command: argparse.ArgumentParser) -> None:
    """Add the options that choose a trained agent."""
    command.add_argument("folder", nargs="?", help="output folder of a training run")
    command.add_argument(
        "--pretrained",
        metavar="NAME",
        help="in its place a policy that comes with the package, as halfcheetah",
    )
    command.add_argument("--steps", type=int, help="of which checkpoint (default: the latest)")
    command.add_argument(
        "--clips",
        metavar="FOLDER",
        help="of the clips, where it is not that of the training; train wants the same clips in it",
    )
    command.add_argument("--best", action="store_true", help="take the best checkpoint")
    command.add_argument(
        "--run",
        dest="run_index",
        type=int,
        default=0,
        help="which of the runs of --seeds, from 0 (default: 0)",
    )


def _add_evaluate(commands: Any) -> None:
    command = commands.add_parser(
        "evaluate",
        help="returns of a trained agent",
        description="Plays whole episodes of a checkpoint with the mean action, the same ones "
        "every time, and writes a line of JSON for each split.",
    )
    _add_trained(command)
    command.add_argument("--episodes", type=int, default=32, help="of each split (default: 32)")
    command.add_argument(
        "--split",
        nargs="+",
        choices=("clean", "train", "test"),
        help="default: clean, with distractors train too, and test where there are clips that "
        "training never shows",
    )
    command.set_defaults(run=_evaluate)


def _evaluate(options: argparse.Namespace) -> int:
    try:
        from pixelbrax_jax.agents.runner.evaluate_command import evaluate
    except ImportError as error:
        return _lacks_train("evaluate", error)
    return evaluate(options)


def _add_record(commands: Any) -> None:
    command = commands.add_parser(
        "record",
        help="make a video of a trained agent",
        description="Plays several episodes of a checkpoint side by side and writes an MP4.",
    )
    _add_trained(command)
    command.add_argument(
        "--output", help="an .mp4 or .gif (default: videos/<steps>_<split>.mp4 in the folder)"
    )
    command.add_argument(
        "--split", help="clean, train or test (default: train, or clean without distractors)"
    )
    command.add_argument("--grid", type=int, default=3, help="episodes a side (default: 3)")
    command.add_argument("--size", type=int, default=168, help="pixels of one (default: 168)")
    command.add_argument("--num-frames", type=int, default=300, help="at most (default: 300)")
    command.add_argument("--seed", type=int, default=0, help="of the episodes (default: 0)")
    command.set_defaults(run=_record)


def _record(options: argparse.Namespace) -> int:
    try:
        from pixelbrax_jax.agents.runner.record import record
    except ImportError as error:
        return _lacks_train("record", error)
    return record(options)


def _bench(arguments: list[str]) -> int:
    try:
        from pixelbrax_gym.bench.command import main as bench
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    return bench(arguments)


def _version() -> str:
    try:
        return version("pixelbrax")
    except PackageNotFoundError:
        return "not installed"


def _doctor(options: argparse.Namespace) -> int:
    del options
    from pixelbrax_gym import doctor

    findings = doctor.diagnose(doctor.inspect())
    sys.stdout.write(doctor.report(findings) + "\n")
    return int(any(finding.level == "problem" for finding in findings))


if __name__ == "__main__":
    sys.exit(main())
