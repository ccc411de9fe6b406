"""Numbers of a training run: put together over iterations, and written where people look."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

_SUMS = ("episode/return_sum", "episode/length_sum", "episode/count")


def together(records: list[Mapping[str, Any]]) -> dict[str, float]:
    """One record of several iterations.

    Episodes count equally, whichever iteration they ended in; all else is the mean over
    iterations. Without a finished episode there is no return and no length.

    Args:
        records: metrics of iterations; some may have more names than others. Of several runs
            they have a leading axis; the summary is over all of them, with each run's return.
    """
    names = {name: None for record in records for name in record}
    values = {
        name: np.asarray([record[name] for record in records if name in record], np.float64)
        for name in names
    }
    count = float(values["episode/count"].sum())
    summary = {"episode/count": count}
    if count:
        summary["episode/return"] = float(values["episode/return_sum"].sum()) / count
        summary["episode/length"] = float(values["episode/length_sum"].sum()) / count
        counts, sums = values["episode/count"].sum(0), values["episode/return_sum"].sum(0)
        for run in np.flatnonzero(counts) if np.ndim(counts) else ():
            summary[f"episode/return/run_{run}"] = float(sums[run] / counts[run])
    return summary | {n: float(v.mean()) for n, v in values.items() if n not in _SUMS}


class MetricsWriter:
    """Writes records to ``metrics.jsonl`` and TensorBoard, and to Weights & Biases if asked.

    The settings are written to ``config.json``, for people and scripts; nothing reads it back.

    Attributes:
        path: of the JSONL file: one object a line with ``steps``, ``seconds`` and the metrics.
    """

    def __init__(
        self,
        folder: Path,
        config: dict[str, Any],
        *,
        first_step: int = 0,
        wandb_project: str | None = None,
    ) -> None:
        """Opens the files.

        Args:
            folder: where they are.
            config: settings by name, as JSON has them.
            first_step: control steps at which the run goes on; later records of an earlier
                attempt are dropped, for they will be written again.
            wandb_project: project of Weights & Biases; None writes nothing there.

        Raises:
            ImportError: a project is given, but wandb is not installed.
        """
        from tensorboardX import SummaryWriter

        folder.mkdir(parents=True, exist_ok=True)
        (folder / "config.json").write_text(json.dumps(config, indent=2) + "\n", "utf-8")
        self.path = folder / "metrics.jsonl"
        self._seconds = _keep_until(self.path, first_step)
        self._began = time.monotonic()
        self._file = self.path.open("a", encoding="utf-8")
        board = folder / "tensorboard"
        # TensorBoard forgets what an earlier attempt wrote beyond this step.
        self._board = SummaryWriter(str(board), purge_step=first_step + 1 if first_step else 0)
        self._wandb = None
        if wandb_project is not None:
            try:
                import wandb
            except ImportError as error:
                raise ImportError(
                    "wandb_project is given, but wandb is not installed: pip install wandb"
                ) from error
            self._wandb = wandb.init(project=wandb_project, config=config, dir=str(folder))

    def write(self, steps: int, record: Mapping[str, float]) -> None:
        """One record.

        Args:
            steps: control steps so far, any size.
            record: numbers by name.
        """
        seconds = self._seconds + time.monotonic() - self._began
        line = {"steps": steps, "seconds": round(seconds, 3)} | dict(record)
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()
        for name, value in record.items():
            self._board.add_scalar(name, value, steps)
        if self._wandb is not None:
            self._wandb.log(dict(record) | {"steps": steps})

    def close(self) -> None:
        """Closes the files."""
        self._file.close()
        self._board.close()
        if self._wandb is not None:
            self._wandb.finish()


class NoWriter:
    """What processes other than the first write: nothing."""

    def write(self, steps: int, record: Mapping[str, float]) -> None:
        """Nothing."""

    def close(self) -> None:
        """Nothing."""


def read_metrics(path: str | Path) -> list[dict[str, float]]:
    """All records of a ``metrics.jsonl``; a last line that was cut off is left out."""
    records = []
    for line in Path(path).read_text("utf-8").splitlines():
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return records


def _keep_until(path: Path, first_step: int) -> float:
    """Drops records beyond a step; the seconds that the kept ones took."""
    if not path.exists():
        return 0.0
    kept = [r for r in read_metrics(path) if first_step and r["steps"] <= first_step]
    fresh = path.with_suffix(".part")
    fresh.write_text("".join(json.dumps(record) + "\n" for record in kept), "utf-8")
    fresh.replace(path)
    return kept[-1]["seconds"] if kept else 0.0
