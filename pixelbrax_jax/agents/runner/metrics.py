"""Summarise the metrics of a run and write them to JSON, TensorBoard and Weights & Biases."""

from __future__ import annotations

import json
import os
import socket
import struct
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.proto.summary_pb2 import Summary
from tensorboardX.record_writer import masked_crc32c

from pixelbrax_jax.agents.runner.progress import Report, reason
from pixelbrax_jax.paths import replacing

_SUMS = ("episode/return_sum", "episode/length_sum", "episode/count")

_SERVICE = "Weights & Biases"

_MAX_WAITING = 64 * 2**20
"""Maximum number of bytes in memory for a file that cannot be written."""


def summarize(records: list[Mapping[str, Any]]) -> dict[str, float]:
    """Combine the metrics of several iterations, whose names may differ, into one record.

    All episodes have the same weight; other metrics are averaged over iterations. Return and length
    are missing if no episode ended. Metrics of several runs have a leading axis; the record
    averages over it and adds each run's return.
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
    """An append-only file without gaps, which keeps bytes in memory while the disk is full."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("ab", buffering=0)
        self._waiting = bytearray()
        self._ended = False

    def append(self, block: bytes = b"") -> None:
        """Write the waiting bytes and a block; raise an OSError if some bytes still wait."""
        self._ended = self._ended or len(self._waiting) + len(block) > _MAX_WAITING
        if not self._ended:
            self._waiting += block
        while self._waiting:
            # The disk may accept only a part.
            del self._waiting[: self._file.write(self._waiting)]
        if self._ended:
            raise OSError("more than 64 MiB waited for free disk space")

    def close(self) -> None:
        """Write the waiting bytes and close the file, or raise an OSError."""
        try:
            self.append()
        finally:
            self._file.close()


@dataclass
class _Output:
    """A destination of records, whose functions may raise.

    Attributes:
        retries: whether ``write`` keeps failed records and retries them.
        failure: why records are missing, or empty.
        last: steps of the last record that was written.
    """

    name: str
    write: Callable[[int, float, Mapping[str, float]], None]
    close: Callable[[], None]
    last: int
    retries: bool = True
    failure: str = ""


def _lines(path: Path, first_step: int) -> _Output:
    file = AppendedFile(path)

    def write(steps: int, seconds: float, record: Mapping[str, float]) -> None:
        line = {"steps": steps, "seconds": round(seconds, 3)} | dict(record)
        file.append(json.dumps(line).encode() + b"\n")

    return _Output(str(path), write, file.close, first_step)


def _tensorboard(folder: Path, first_step: int) -> _Output:
    """Open an event file of TensorBoard; tensorboardX's writer would block after an error."""
    folder.mkdir(parents=True, exist_ok=True)
    name = f"events.out.tfevents.{int(time.time())}.{socket.gethostname()}.{os.getpid()}"
    file = AppendedFile(folder / name)

    def add(**event: Any) -> None:
        """Append an event in the TFRecord format: length and bytes, each with a checksum."""
        data = Event(wall_time=time.time(), **event).SerializeToString()
        length = struct.pack("<Q", len(data))
        ends = [struct.pack("<I", masked_crc32c(part)) for part in (length, data)]
        file.append(length + ends[0] + data + ends[1])

    def write(steps: int, seconds: float, record: Mapping[str, float]) -> None:
        del seconds
        values = [Summary.Value(tag=name, simple_value=value) for name, value in record.items()]
        add(step=steps, summary=Summary(value=values))

    # A SessionLog tells TensorBoard to drop the records of an earlier attempt after this step.
    start = first_step + 1 if first_step else 0
    add(step=start, file_version="brain.Event:2")
    add(step=start, session_log=SessionLog(status=SessionLog.START))
    return _Output(str(folder), write, file.close, first_step)


def _wandb(
    project: str, config: dict[str, Any], folder: Path, first_step: int, report: Report
) -> _Output:
    try:
        import wandb
    except ImportError as error:
        raise ImportError(
            "wandb_project needs wandb, which is not installed: pip install wandb"
        ) from error
    try:
        # A resumed run continues the same run of the service.
        known = folder / "wandb_id"
        if not known.exists():
            with replacing(known) as part:
                part.write_text(uuid.uuid4().hex[:8] + "\n", "utf-8")
        name = known.read_text("utf-8").strip()
        run = wandb.init(project=project, config=config, dir=str(folder), id=name, resume="allow")
        with ExitStack() as undo:
            undo.callback(run.finish)
            run.define_metric("*", step_metric="steps")
            undo.pop_all()
    except Exception as error:  # The package has errors of many kinds.
        report(f"cannot log to {_SERVICE}: {reason(error)}; training continues without it")
        nothing: Any = lambda *_: None  # noqa: E731
        return _Output(_SERVICE, nothing, nothing, first_step, retries=False, failure=reason(error))

    def write(steps: int, seconds: float, record: Mapping[str, float]) -> None:
        del seconds
        run.log(dict(record) | {"steps": steps})

    return _Output(_SERVICE, write, run.finish, first_step, retries=False)


class MetricsWriter:
    """Writes records to all outputs; never raises, and reports the first error of each output."""

    def __init__(self, report: Report, outputs: Sequence[_Output] = (), seconds: float = 0) -> None:
        """Start the clock at ``seconds``."""
        self._report, self._outputs = report, outputs
        self._began = time.monotonic() - seconds

    def write(self, steps: int, record: Mapping[str, float]) -> None:
        """Write the record after ``steps`` control steps."""
        seconds = time.monotonic() - self._began
        for output in self._outputs:
            if output.failure and not output.retries:
                continue
            with self._watched(output):
                output.write(steps, seconds, record)
                output.last = steps
                if output.failure:
                    output.failure = ""
                    self._report(f"{output.name} can be written again; missing records were added")

    def close(self) -> None:
        """Close the files."""
        for output in self._outputs:
            with self._watched(output):
                output.close()
                if output.retries:
                    output.failure = ""

    def missing(self) -> list[str]:
        """Return a line for each output that lacks records."""
        return [
            f"{output.name} may lack records after {output.last} steps: {output.failure}"
            for output in self._outputs
            if output.failure
        ]

    @contextmanager
    def _watched(self, output: _Output) -> Iterator[None]:
        """Store an error, and report the first one."""
        try:
            yield
        except Exception as error:
            if not output.failure:
                lines = self._outputs[0].name
                then = (
                    "its records wait in memory" if output.retries else f"{lines} has all records"
                )
                self._report(
                    f"cannot write to {output.name}: {reason(error)}; training continues, {then}"
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
    """Open ``metrics.jsonl``, TensorBoard's file and, with a project, Weights & Biases.

    Also writes ``config.json``, and drops records of an earlier attempt after ``first_step``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(json.dumps(config, indent=2) + "\n", "utf-8")
    path = folder / "metrics.jsonl"
    seconds = _keep_until(path, first_step)
    outputs = [_lines(path, first_step), _tensorboard(folder / "tensorboard", first_step)]
    if wandb_project is not None:
        outputs.append(_wandb(wandb_project, config, folder, first_step, report))
    return MetricsWriter(report, outputs, seconds)


def read_metrics(path: str | Path) -> list[dict[str, float]]:
    """Read all records of a ``metrics.jsonl``, without an incomplete last line."""
    records = []
    for line in Path(path).read_text("utf-8").splitlines():
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return records


def _keep_until(path: Path, first_step: int) -> float:
    """Drop the records after a step, and return the seconds of the last record before."""
    if not path.exists():
        return 0.0
    kept = [r for r in read_metrics(path) if first_step and r["steps"] <= first_step]
    with replacing(path) as part:
        part.write_text("".join(json.dumps(record) + "\n" for record in kept), "utf-8")
    return kept[-1]["seconds"] if kept else 0.0
