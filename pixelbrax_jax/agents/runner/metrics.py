"""Numbers of a training run: put together over iterations, and written where people look."""

from __future__ import annotations

import json
import os
import socket
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.proto.summary_pb2 import Summary
from tensorboardX.record_writer import masked_crc32c

from pixelbrax_jax.agents.runner.progress import Report, reason

_SUMS = ("episode/return_sum", "episode/length_sum", "episode/count")

_MAX_WAITING = 64 * 2**20
"""Bytes kept in memory for a file that cannot be written."""


def summarize(records: list[Mapping[str, Any]]) -> dict[str, float]:
    """Return one record of several iterations, of which some may have more names than others.

    Episodes count equally, whichever iteration they ended in; all else is the mean. Without a
    finished episode there is no return and no length. Metrics of several runs have a leading axis,
    over which the record is too, with each run's return.
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


class AppendedFile:
    """A file that bytes are appended to; those the disk does not take are kept for the next time.

    Nothing is written twice or left out in between: the file is complete as soon as all could be
    written, and lacks only its end until then.
    """

    def __init__(self, path: Path) -> None:
        """Open the file, which is made if need be."""
        self._file = path.open("ab", buffering=0)
        self._waiting = bytearray()
        self._ended = False

    def append(self, block: bytes = b"") -> None:
        """Write what waits, then a block; an OSError if some of it waits still.

        The file ends where more than 64 MiB would have to wait.
        """
        self._ended = self._ended or len(self._waiting) + len(block) > _MAX_WAITING
        if not self._ended:
            self._waiting += block
        while self._waiting:
            # The disk may take a part of it.
            del self._waiting[: self._file.write(self._waiting)]
        if self._ended:
            raise OSError("more waited for room on the disk than is kept in memory")

    def close(self) -> None:
        """Write what waits and close the file, or raise an OSError."""
        try:
            self.append()
        finally:
            self._file.close()


@dataclass
class _Output:
    """A place that records are written to; both functions may raise."""

    name: str
    write: Callable[[int, float, Mapping[str, float]], None]
    """Takes steps, seconds and the record."""
    close: Callable[[], None]
    retries: bool = True
    """Whether ``write`` keeps what it could not write, and tries again the next time."""
    failure: str = ""
    """Why records are missing; empty while none is."""
    last: int = 0
    """Steps of the last record that is there for certain."""


def _lines(path: Path) -> _Output:
    """Open ``metrics.jsonl``."""
    file = AppendedFile(path)

    def write(steps: int, seconds: float, record: Mapping[str, float]) -> None:
        line = {"steps": steps, "seconds": round(seconds, 3)} | dict(record)
        file.append(json.dumps(line).encode() + b"\n")

    return _Output(str(path), write, file.close)


def _tensorboard(folder: Path, first_step: int) -> _Output:
    """Open an event file of TensorBoard.

    It is written by the thread that trains. tensorboardX's own writer has a thread that ends at
    the first error, behind which ``add_scalar`` blocks for ever.
    """
    folder.mkdir(parents=True, exist_ok=True)
    name = f"events.out.tfevents.{int(time.time())}.{socket.gethostname()}.{os.getpid()}"
    file = AppendedFile(folder / name)

    def add(event: Any) -> None:
        """Append an event in the TFRecord format: length and bytes, each with its checksum."""
        event.wall_time = time.time()
        data = event.SerializeToString()
        length = struct.pack("<Q", len(data))
        ends = [struct.pack("<I", masked_crc32c(part)) for part in (length, data)]
        file.append(length + ends[0] + data + ends[1])

    def write(steps: int, seconds: float, record: Mapping[str, float]) -> None:
        del seconds
        values = [Summary.Value(tag=name, simple_value=value) for name, value in record.items()]
        add(Event(step=steps, summary=Summary(value=values)))

    # TensorBoard forgets what an earlier attempt wrote beyond this step.
    first_step = first_step + 1 if first_step else 0
    add(Event(step=first_step, file_version="brain.Event:2"))
    add(Event(step=first_step, session_log=SessionLog(status=SessionLog.START)))
    return _Output(str(folder), write, file.close)


def _wandb(project: str, config: dict[str, Any], folder: Path) -> _Output:
    """Begin a run of Weights & Biases."""
    try:
        import wandb
    except ImportError as error:
        raise ImportError(
            "wandb_project is given, but wandb is not installed: pip install wandb"
        ) from error
    run = wandb.init(project=project, config=config, dir=str(folder))

    def write(steps: int, seconds: float, record: Mapping[str, float]) -> None:
        del seconds
        run.log(dict(record) | {"steps": steps})

    return _Output("Weights & Biases", write, run.finish, retries=False)


class MetricsWriter:
    """Writes records to all outputs of `open_metrics`, or to none.

    It never raises: what fails is reported, once, and the others go on.
    """

    def __init__(
        self,
        report: Report,
        outputs: Sequence[_Output] = (),
        seconds: float = 0.0,
    ) -> None:
        """Start the clock at ``seconds``."""
        self._report = report
        self._outputs = outputs
        self._began = time.monotonic() - seconds

    def write(self, steps: int, record: Mapping[str, float]) -> None:
        """Write one record, of so many control steps."""
        seconds = time.monotonic() - self._began
        for output in self._outputs:
            if output.failure and not output.retries:
                continue
            try:
                output.write(steps, seconds, record)
            except Exception as error:
                self._fail(output, error)
                continue
            output.last = steps
            if output.failure:
                output.failure = ""
                self._report(f"{output.name} can be written again; what it lacked is written")

    def close(self) -> None:
        """Close the files."""
        for output in self._outputs:
            try:
                output.close()
            except Exception as error:
                self._fail(output, error)
            else:
                if output.retries:
                    output.failure = ""

    def missing(self) -> list[str]:
        """Return one line for each place that lacks records."""
        return [
            f"{output.name} may lack records after {output.last} steps: {output.failure}"
            for output in self._outputs
            if output.failure
        ]

    def _fail(self, output: _Output, error: Exception) -> None:
        if not output.failure:
            lines = self._outputs[0].name
            then = "its records wait in memory" if output.retries else f"all are in {lines}"
            self._report(
                f"cannot write to {output.name}: {reason(error)}; training goes on, {then}"
            )
        output.failure = reason(error)


def open_metrics(
    folder: Path,
    config: dict[str, Any],
    report: Report,
    *,
    first_step: int = 0,
    wandb_project: str | None = None,
) -> MetricsWriter:
    """Open ``metrics.jsonl``, TensorBoard's file and, if asked, Weights & Biases; or raise.

    ``config`` is written to ``config.json`` for people and scripts; nothing reads it back. Records
    of an earlier attempt beyond ``first_step`` are dropped, for they will be written again.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(json.dumps(config, indent=2) + "\n", "utf-8")
    path = folder / "metrics.jsonl"
    seconds = _keep_until(path, first_step)
    outputs = [_lines(path), _tensorboard(folder / "tensorboard", first_step)]
    if wandb_project is not None:
        outputs.append(_wandb(wandb_project, config, folder))
    for output in outputs:
        output.last = first_step
    return MetricsWriter(report, outputs, seconds)


def read_metrics(path: str | Path) -> list[dict[str, float]]:
    """Return all records of a ``metrics.jsonl``; a last line that was cut off is left out."""
    records = []
    for line in Path(path).read_text("utf-8").splitlines():
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return records


def _keep_until(path: Path, first_step: int) -> float:
    """Drop records beyond a step, and return the seconds that the kept ones took."""
    if not path.exists():
        return 0.0
    kept = [r for r in read_metrics(path) if first_step and r["steps"] <= first_step]
    fresh = path.with_suffix(".part")
    fresh.write_text("".join(json.dumps(record) + "\n" for record in kept), "utf-8")
    fresh.replace(path)
    return kept[-1]["seconds"] if kept else 0.0
