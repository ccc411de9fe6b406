"""When a run writes checkpoints, and what it does when one cannot be written."""

from __future__ import annotations

import math
import time
from typing import Any

import jax

from pixelbrax_jax.agents.runner.checkpoint import CheckpointError, Checkpoints, DiskFullError
from pixelbrax_jax.agents.runner.progress import Report

_RETRY_MINUTES = 1.0


class Saver:
    """Writes the checkpoints of a run.

    One that cannot be written is reported and tried again, and training goes on; but for the last
    one, which is an error.
    """

    def __init__(
        self,
        checkpoints: Checkpoints,
        steps: int,
        report: Report,
        *,
        every: int,
        minutes: float,
    ) -> None:
        """Start the clock at ``steps``; ``every`` and ``minutes`` are those of ``RunConfig``."""
        self._checkpoints = checkpoints
        self._report = report
        self._every = every
        self._minutes = minutes
        self._last_steps = steps
        self._due = self._in_minutes(minutes)
        self._failing = False

    def is_due_by_clock(self) -> bool:
        """Return whether it is time for a checkpoint; processes have different clocks."""
        return time.monotonic() >= self._due

    def is_due_after(self, steps: int) -> bool:
        """Return whether so many steps ask for a checkpoint."""
        return bool(self._every) and steps // self._every > self._last_steps // self._every

    def save(self, state: Any, steps: int, score: float | None, *, last: bool) -> None:
        """As ``Checkpoints.save``; the last one is waited for.

        Raises:
            CheckpointError: the last one cannot be written, or of several processes only some can.
        """
        self.look_after(wait=True)
        self._last_steps, self._due = steps, self._in_minutes(self._minutes)
        try:
            self._checkpoints.save(state, steps, score)
            if last:
                self._checkpoints.wait()
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
        try:
            if wait:
                self._checkpoints.wait()
            # Of several processes, all must look at the same time.
            elif jax.process_count() > 1 or not self._checkpoints.is_written():
                return
        except CheckpointError as error:
            self._fail(error)
            return
        if self._failing and self.latest() == self._last_steps:
            self._failing = False
            self._report(f"the checkpoint of {self._last_steps} steps is written")

    def latest(self) -> int | None:
        """Return the steps of the latest checkpoint; None if there is none."""
        return max(self._checkpoints.steps(), default=None)

    def _fail(self, error: CheckpointError) -> None:
        if jax.process_count() > 1 and not isinstance(error, DiskFullError):
            raise error
        if not self._failing:
            self._report(f"{error} Training goes on, and a checkpoint is tried again.")
        self._failing = True
        self._due = self._in_minutes(min(self._minutes, _RETRY_MINUTES))

    def _in_minutes(self, minutes: float) -> float:
        return time.monotonic() + 60 * minutes if self._minutes else math.inf
