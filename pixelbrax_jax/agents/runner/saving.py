"""Where training stands, on disk: written whole or not at all, and read back to the bit."""

from __future__ import annotations

import logging
import math
import shutil
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from pixelbrax_jax.agents.runner.checkpoint import (
    FORMAT,
    CheckpointError,
    DiskFullError,
    Tree,
    leaves_of,
    read_about,
    shapes_of,
    sharding_of,
    tree_of,
    without_warnings,
)
from pixelbrax_jax.agents.runner.devices import any_process
from pixelbrax_jax.agents.runner.progress import Report, silent
from pixelbrax_jax.agents.runner.settings import differences, unknown_settings, versions

_ROOM = 1.2
"""Free bytes on the disk that are asked for, in sizes of a checkpoint."""

_RETRY_MINUTES = 1.0


class Checkpoints:
    """The checkpoints of one run.

    Each is a folder named by the number of control steps. It appears under that name only when
    it is complete, so that a run that is killed while writing leaves the one before. One that
    cannot be written is reported and tried again; but for the last one, which is an error.
    """

    def __init__(
        self,
        folder: str | Path,
        about: Mapping[str, Any],
        *,
        keep: int = 3,
        former: Mapping[str, Any] | None = None,
        every: int = 0,
        minutes: float = 0.0,
        report: Report = silent,
    ) -> None:
        """Open the folder, or raise a CheckpointError if it cannot be written to.

        Args:
            folder: of the checkpoints, which is made if need be.
            about: of ``describe_run``, stored with every checkpoint.
            keep: as ``RunConfig.keep_checkpoints``.
            former: by name, what a stored run had that lacks a setting.
            every: as ``RunConfig.checkpoint_every``.
            minutes: as ``RunConfig.checkpoint_minutes``.
            report: gets a line about checkpoints that cannot be written.
        """
        self.folder = Path(folder).absolute()
        self._about = {"format": FORMAT, **about, "versions": versions()}
        self._former = dict(former or {})
        self._every, self._minutes, self._report = every, minutes, report
        _check_writable(self.folder)
        policy = ocp.checkpoint_managers
        best = policy.BestN(
            get_metric_fn=lambda m: m["score"], n=1, keep_checkpoints_without_metrics=False
        )
        options = ocp.CheckpointManagerOptions(
            preservation_policy=policy.AnyPreservationPolicy([policy.LatestN(keep), best]),
            # Without it scores are not written, and a resumed run would drop the best.
            best_fn=lambda metrics: metrics["score"],
            cleanup_tmp_directories=True,
        )
        self._manager = ocp.CheckpointManager(self.folder, options=options)
        self._writing = self._failing = False
        self._last_steps = self.latest() or 0
        self._due = self._in_minutes(minutes)
        logging.getLogger("absl").addFilter(_not_a_traceback)

    def steps(self) -> list[int]:
        """Return control steps of all checkpoints, ascending."""
        return sorted(self._manager.all_steps())

    def latest(self) -> int | None:
        """Return the steps of the latest checkpoint; None if there is none."""
        return max(self._manager.all_steps(), default=None)

    def is_due_by_clock(self) -> bool:
        """Return whether it is time for a checkpoint; processes have different clocks."""
        return time.monotonic() >= self._due

    def is_due_after(self, steps: int) -> bool:
        """Return whether so many steps ask for a checkpoint."""
        return bool(self._every) and steps // self._every > self._last_steps // self._every

    def save(self, state: Any, steps: int, score: float | None, *, last: bool = False) -> None:
        """Begin to write a checkpoint; training may go on meanwhile.

        Args:
            state: any pytree of arrays.
            steps: control steps so far.
            score: the higher, the better; None if it is not known.
            last: whether the run stops behind it: it is waited for, and must be written.

        Raises:
            CheckpointError: it must be written and cannot be, or only some processes can.
        """
        self.look_after(wait=True)
        self._last_steps, self._due = steps, self._in_minutes(self._minutes)
        try:
            self._write(state, steps, score)
            if last:
                self._wait()
        except CheckpointError as error:
            if not last:
                self._fail(error)
                return
            latest = self.latest()
            kept = "there is no other" if latest is None else f"that of {latest} steps stays"
            raise CheckpointError(
                f"the checkpoint of {steps} steps, the last one, is lost; {kept}. {error} "
                "Make room or mend the folder, and go on with --resume latest."
            ) from error

    def look_after(self, *, wait: bool = False) -> None:
        """Tell what has become of the checkpoint that is being written; raises as `save`."""
        if not wait:
            # Of several processes, all must look at the same time.
            if jax.process_count() > 1 or not self._writing:
                return
            if self._manager.is_saving_in_progress():
                return
        try:
            self._wait()
        except CheckpointError as error:
            self._fail(error)
            return
        if self._failing and self.latest() == self._last_steps:
            self._failing = False
            self._report(f"the checkpoint of {self._last_steps} steps is written")

    def restore(self, template: Tree) -> Tree:
        """Return the state of the latest checkpoint, equal to the bit to what was saved.

        ``template`` is a state of the same shapes, or its ``jax.eval_shape``. A checkpoint of other
        settings or of another format is a CheckpointError.
        """
        about = read_about(self.folder)
        self._check(about)
        wanted = leaves_of(template)
        self._check_arrays(about, wanted)
        targets = {
            name: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding_of(leaf))
            for name, leaf in wanted.items()
        }
        restored = self._manager.restore(
            about["steps"], args=ocp.args.Composite(state=ocp.args.StandardRestore(targets))
        )
        return tree_of(template, restored["state"])

    def other_versions(self) -> list[str]:
        """Return packages whose versions, and devices whose kind or number, were others then."""
        old, new = read_about(self.folder)["versions"], self._about["versions"]
        return [
            f"{name} {old.get(name)} there, {new.get(name)} here"
            for name in sorted(old.keys() | new.keys())
            if old.get(name) != new.get(name)
        ]

    def close(self) -> None:
        """Wait for what is being written, and let go of the folder."""
        try:
            self._wait()
        finally:
            # `_wait` has raised what it may raise of a full disk.
            with suppress(OSError, ValueError):
                self._manager.close()
            logging.getLogger("absl").removeFilter(_not_a_traceback)

    def _write(self, state: Any, steps: int, score: float | None) -> None:
        leaves = leaves_of(state)
        size = sum(leaf.nbytes for leaf in leaves.values())
        try:
            free = shutil.disk_usage(self.folder).free
        except OSError as error:
            raise self._failed(error) from error
        if any_process(free < _ROOM * size):
            raise DiskFullError(
                f"a checkpoint takes {_bytes(size)}, but {self.folder} has only {_bytes(free)} "
                "free."
            )
        about = self._about | {"steps": steps, "score": score}
        arguments = ocp.args.Composite(
            state=ocp.args.StandardSave(leaves), about=ocp.args.JsonSave(about)
        )
        metrics = None if score is None else {"score": score}
        try:
            with without_warnings():  # That there is no score is no mistake.
                self._manager.save(steps, args=arguments, metrics=metrics, force=True)
        except (OSError, ValueError) as error:
            raise self._failed(error) from error
        self._writing = True

    def _wait(self) -> None:
        """Return when everything is written, or raise a CheckpointError."""
        self._writing = False
        try:
            self._manager.wait_until_finished()
        except (OSError, ValueError) as error:  # TensorStore has a ValueError for a full disk.
            raise self._failed(error) from error

    def _fail(self, error: CheckpointError) -> None:
        if jax.process_count() > 1 and not isinstance(error, DiskFullError):
            raise error
        if not self._failing:
            self._report(f"{error} Training goes on, and a checkpoint is tried again.")
        self._failing = True
        self._due = self._in_minutes(min(self._minutes, _RETRY_MINUTES))

    def _in_minutes(self, minutes: float) -> float:
        return time.monotonic() + 60 * minutes if self._minutes else math.inf

    def _failed(self, error: Exception) -> CheckpointError:
        """Return what to raise for a checkpoint that cannot be written; removes what there is."""
        if jax.process_index() == 0:
            for path in self.folder.glob("*.orbax-checkpoint-tmp*"):
                shutil.rmtree(path, ignore_errors=True)
        # The manager has left out those that the new one would have replaced.
        with suppress(OSError):
            self._manager.reload()
        # TensorStore's messages end with the system's own words.
        reason = str(error).partition("\n")[0].rsplit(": ", 1)[-1]
        reason = getattr(error, "strerror", None) or reason or type(error).__name__
        return CheckpointError(f"cannot write a checkpoint to {self.folder}: {reason}.")

    def _check(self, about: dict[str, Any]) -> None:
        """Reject a checkpoint of another format, algorithm or settings."""
        own = self._about
        if about["format"] != FORMAT:
            raise CheckpointError(
                f"{self.folder} has format {about['format']!r}, of which this version reads the "
                "networks alone: evaluate or record the run, and train anew in another "
                "--output-dir."
            )
        if about["algorithm"] != own["algorithm"]:
            raise CheckpointError(
                f"{self.folder} is a run of {about['algorithm']}, not of {own['algorithm']}; give "
                "another --output-dir."
            )
        about = about | {"config": self._former | about["config"]}
        old, new = about["config"], own["config"]
        if other := differences(about, own):
            why = unknown_settings(about, new)
            if old.get("total_steps") != new.get("total_steps") and new.get("anneal"):
                why += "A step size that falls over all of total_steps leaves them fixed. "
            raise CheckpointError(
                f"the checkpoint in {self.folder} has other settings: {'; '.join(other)}. "
                f"{why}Use the same ones, or another --output-dir."
            )

    def _check_arrays(self, about: dict[str, Any], wanted: dict[str, Any]) -> None:
        """Reject a checkpoint whose arrays are others."""
        stored = shapes_of(self.folder / str(about["steps"]) / "state")
        shapes = {name: tuple(leaf.shape) for name, leaf in wanted.items()}
        other = [
            f"{name}: {stored.get(name, 'none')} there, {shapes.get(name, 'none')} here"
            for name in sorted(stored.keys() | shapes.keys())
            if stored.get(name) != shapes.get(name)
        ]
        if other:
            more = f" and {len(other) - 3} more" if len(other) > 3 else ""
            others = "; ".join(self.other_versions()) or "the versions are the same"
            raise CheckpointError(
                f"the checkpoint in {self.folder} has other arrays: {'; '.join(other[:3])}{more} "
                f"({others}). Go on with what wrote it, or train anew in another --output-dir."
            )


def _check_writable(folder: Path) -> None:
    """Reject a folder that cannot be made or written to."""
    probe = folder / ".writable"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"")
        probe.unlink(missing_ok=True)  # Other processes try the same.
    except OSError as error:
        raise CheckpointError(
            f"cannot write to {folder}: {error.strerror or error}. Give another --output-dir."
        ) from error


def _bytes(number: float) -> str:
    """Return a number of bytes with a unit in which it shows."""
    return f"{number / 1e9:.2f} GB" if number >= 1e8 else f"{number / 1e6:.2f} MB"


def _not_a_traceback(record: logging.LogRecord) -> bool:
    """Return whether a record is no traceback of Orbax, whose errors `Checkpoints` raises."""
    return not (record.exc_info and "orbax" in record.pathname)
