"""What follows each iteration of a run, and in which order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Job = Literal["log", "evaluate", "save", "report_stop"]


@dataclass(frozen=True)
class Schedule:
    """When a run learns, logs, evaluates and saves; iterations are counted from 1.

    Attributes:
        num_iterations: of the whole run.
        num_phases: iterations from one auxiliary phase to the next; 0 has none.
        log_every: iterations from one record of metrics to the next.
        num_evals: evaluations of the whole run, evenly spread; the last one follows its end.
    """

    num_iterations: int
    num_phases: int
    log_every: int
    num_evals: int

    def has_auxiliary_phase(self, number: int) -> bool:
        """Return whether an auxiliary phase follows iteration ``number``."""
        return bool(self.num_phases) and number % self.num_phases == 0

    def evaluates(self, number: int) -> bool:
        """Return whether an evaluation is due after iteration ``number``."""
        before, after = ((n * self.num_evals) // self.num_iterations for n in (number - 1, number))
        return after > before

    def jobs(self, number: int, *, save: bool = False, stop: bool = False) -> tuple[Job, ...]:
        """Return what is to be done after iteration ``number``, in this order.

        Args:
            number: of the iteration.
            save: whether a checkpoint is due by steps or by clock.
            stop: whether the run is asked to stop.
        """
        evaluate = self.evaluates(number)
        save = save or evaluate or stop or number == self.num_iterations
        log = save or number % self.log_every == 0
        jobs: list[tuple[Job, bool]] = [("log", log), ("evaluate", evaluate), ("save", save)]
        if stop:
            # Whoever is asked to stop may soon be killed: first what must not be lost.
            jobs = [("log", log), ("save", save), ("report_stop", True), ("evaluate", evaluate)]
        return tuple(job for job, due in jobs if due)
