"""Write and restore checkpoints atomically and bit-exactly."""

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
"""Free space that a checkpoint requires, relative to its size."""

_RETRY_MINUTES = 1.0


class Checkpoints:
    """The checkpoints of one run, in folders named by the number of control steps.

    A folder gets its name when it is complete, so a killed run leaves the previous checkpoint. A
    checkpoint that cannot be written is reported and retried; for the last one it is an error.
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
        """Create the folder, or raise a CheckpointError if it cannot be written.

        Every checkpoint stores ``about``, the result of ``describe_run``. ``former`` has values of
        settings that a stored run may lack. ``RunConfig`` describes the other options.
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
            # Stores the scores, without which a resumed run would delete the best checkpoint.
            best_fn=lambda metrics: metrics["score"],
            cleanup_tmp_directories=True,
        )
        self._manager = ocp.CheckpointManager(self.folder, options=options)
        self._writing = self._failing = False
        self._last_steps = self.latest() or 0
        self._due = self._in_minutes(minutes)
        logging.getLogger("absl").addFilter(_not_a_traceback)

    def steps(self) -> list[int]:
        """Return the control steps of all checkpoints, ascending."""
        return sorted(self._manager.all_steps())

    def latest(self) -> int | None:
        """Return the steps of the latest checkpoint, or None."""
        return max(self._manager.all_steps(), default=None)

    def is_due_by_clock(self) -> bool:
        """Return whether the clock of this process demands a checkpoint."""
        return time.monotonic() >= self._due

    def is_due_after(self, steps: int) -> bool:
        """Return whether this number of control steps demands a checkpoint."""
        return bool(self._every) and steps // self._every > self._last_steps // self._every

    def save(self, state: Any, steps: int, score: float | None, *, last: bool = False) -> None:
        """Start to write a checkpoint of a pytree after ``steps`` control steps.

        A higher ``score`` is better. With ``last`` it waits for the checkpoint.

        Raises:
            CheckpointError: the last checkpoint cannot be written, or only some processes fail.
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
            kept = "no other exists" if latest is None else f"that of {latest} steps remains"
            raise CheckpointError(
                f"the last checkpoint, of {steps} steps, is lost; {kept}. {error} Free disk space "
                "or make the folder writable, then continue with --resume latest."
            ) from error

    def look_after(self, *, wait: bool = False) -> None:
        """Report the result of the current checkpoint; raises like `save`."""
        if not wait:
            # Several processes must look at the same time, which only `wait` ensures.
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
        """Restore the latest checkpoint; ``template`` is a state or its ``jax.eval_shape``.

        Raises:
            CheckpointError: the checkpoint has another format, other settings or other arrays.
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
        """Describe packages and devices that differ from those of the checkpoint."""
        old, new = read_about(self.folder)["versions"], self._about["versions"]
        return [
            f"{name} {old.get(name)} there, {new.get(name)} here"
            for name in sorted(old.keys() | new.keys())
            if old.get(name) != new.get(name)
        ]

    def close(self) -> None:
        """Finish the current checkpoint and close the folder."""
        try:
            self._wait()
        finally:
            # `_wait` has already raised the errors of a full disk.
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
                f"a checkpoint needs {_bytes(size)}, but {self.folder} has only {_bytes(free)} "
                "free."
            )
        about = self._about | {"steps": steps, "score": score}
        arguments = ocp.args.Composite(
            state=ocp.args.StandardSave(leaves), about=ocp.args.JsonSave(about)
        )
        metrics = None if score is None else {"score": score}
        try:
            with without_warnings():  # A checkpoint may have no score.
                self._manager.save(steps, args=arguments, metrics=metrics, force=True)
        except (OSError, ValueError) as error:
            raise self._failed(error) from error
        self._writing = True

    def _wait(self) -> None:
        self._writing = False
        try:
            self._manager.wait_until_finished()
        except (OSError, ValueError) as error:  # TensorStore raises ValueError for a full disk.
            raise self._failed(error) from error

    def _fail(self, error: CheckpointError) -> None:
        if jax.process_count() > 1 and not isinstance(error, DiskFullError):
            raise error
        if not self._failing:
            self._report(f"{error} Training continues and will retry the checkpoint.")
        self._failing = True
        self._due = self._in_minutes(min(self._minutes, _RETRY_MINUTES))

    def _in_minutes(self, minutes: float) -> float:
        return time.monotonic() + 60 * minutes if self._minutes else math.inf

    def _failed(self, error: Exception) -> CheckpointError:
        """Remove the incomplete checkpoint and return the error to raise."""
        if jax.process_index() == 0:
            for path in self.folder.glob("*.orbax-checkpoint-tmp*"):
                shutil.rmtree(path, ignore_errors=True)
        # The manager has already forgotten the checkpoints that the new one would have replaced.
        with suppress(OSError):
            self._manager.reload()
        # TensorStore's messages end with the message of the operating system.
        reason = str(error).partition("\n")[0].rsplit(": ", 1)[-1]
        reason = getattr(error, "strerror", None) or reason or type(error).__name__
        return CheckpointError(f"cannot write a checkpoint to {self.folder}: {reason}.")

    def _check(self, about: dict[str, Any]) -> None:
        own = self._about
        if about["format"] != FORMAT:
            raise CheckpointError(
                f"{self.folder} has format {about['format']!r}, and this version reads only its "
                "networks: you can evaluate or record the run, but training needs another "
                "--output-dir."
            )
        if about["algorithm"] != own["algorithm"]:
            raise CheckpointError(
                f"{self.folder} is a run of {about['algorithm']}, not of {own['algorithm']}; use "
                "another --output-dir."
            )
        about = about | {"config": self._former | about["config"]}
        old, new = about["config"], own["config"]
        if other := differences(about, own):
            why = unknown_settings(about, new)
            if old.get("total_steps") != new.get("total_steps") and new.get("anneal"):
                why += (
                    "With anneal, total_steps cannot change, because the step size depends on it. "
                )
            raise CheckpointError(
                f"the checkpoint in {self.folder} has other settings: {'; '.join(other)}. "
                f"{why}Use the same settings, or another --output-dir."
            )

    def _check_arrays(self, about: dict[str, Any], wanted: dict[str, Any]) -> None:
        stored = shapes_of(self.folder / str(about["steps"]) / "state")
        shapes = {name: tuple(leaf.shape) for name, leaf in wanted.items()}
        other = [
            f"{name}: {stored.get(name, 'none')} there, {shapes.get(name, 'none')} here"
            for name in sorted(stored.keys() | shapes.keys())
            if stored.get(name) != shapes.get(name)
        ]
        if other:
            more = f" and {len(other) - 3} more" if len(other) > 3 else ""
            others = "; ".join(self.other_versions()) or "the versions are equal"
            raise CheckpointError(
                f"the checkpoint in {self.folder} has other arrays: {'; '.join(other[:3])}{more} "
                f"({others}). Continue with the versions that wrote it, or use another "
                "--output-dir."
            )


def _check_writable(folder: Path) -> None:
    probe = folder / ".writable"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"")
        probe.unlink(missing_ok=True)  # Other processes write the same file.
    except OSError as error:
        raise CheckpointError(
            f"cannot write to {folder}: {error.strerror or error}. Use another --output-dir."
        ) from error


def _bytes(number: float) -> str:
    return f"{number / 1e9:.2f} GB" if number >= 1e8 else f"{number / 1e6:.2f} MB"


def _not_a_traceback(record: logging.LogRecord) -> bool:
    """Reject tracebacks of Orbax, because `Checkpoints` raises its errors."""
    return not (record.exc_info and "orbax" in record.pathname)
