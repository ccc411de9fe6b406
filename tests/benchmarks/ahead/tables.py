"""Compiled programs as tables in Markdown."""

from __future__ import annotations

from collections.abc import Container, Iterator
from itertools import compress

from pixelbrax_gym.bench.tables import number, table
from tests.benchmarks.case import Row
from tests.benchmarks.tables import succeeded, title


def gpu(rows: list[Row], left_out: Container[str] = ()) -> str:
    """Programs for NVIDIA GPUs, without the columns that are left out."""

    def line(row: Row) -> Iterator[str]:
        values = row["values"]
        yield from _about(row, row["arguments"].get("card", "H100"))
        for name in ("kernels", "launches", "longest_chain", "host_steps", "unknown_loops"):
            yield _count(values[name])
        for name in ("temporary_bytes", "output_bytes", "read_bytes", "written_bytes"):
            yield number(values[name] / 1e6)
        yield _count(values["registers"])
        yield _count(values["spilled"])
        yield number(values["model_seconds"]["graph"] * 1e6)

    heads = (
        "card",
        "task",
        "environments",
        "program",
        "kernels",
        "launches",
        "longest chain",
        "parts for the host",
        "loops of unknown length",
        "temporaries, MB",
        "output, MB",
        "read, MB",
        "written, MB",
        "registers",
        "bytes spilled",
        "by a model, us",
    )
    shown = [head not in left_out for head in heads]
    lines = (compress(line(row), shown) for row in succeeded(rows))
    return table(tuple(compress(heads, shown)), lines)


def tpu(rows: list[Row]) -> str:
    """Programs for a TPU."""

    def line(row: Row) -> Iterator[str]:
        values = row["values"]
        yield from _about(row, "v5e")
        for name in ("temporary_bytes", "output_bytes", "accessed_bytes"):
            yield number(values[name] / 1e6 if values[name] is not None else None)
        yield number(values["compile_seconds"])
        model = values["model_seconds"]["xla"]
        yield number(model * 1e3) if model is not None else "not known"

    heads = (
        "TPU",
        "task",
        "environments",
        "program",
        "temporaries, MB",
        "output, MB",
        "accessed, MB",
        "compilation, s",
        "by XLA's model, ms",
    )
    return table(heads, map(line, succeeded(rows)))


def _about(row: Row, device: str) -> Iterator[str]:
    about = row["arguments"]
    names = ("algorithm", "preset", "program")
    program = " ".join(about[name] for name in names if name in about)
    yield from (device, title(about["task"]), f"{about['num_envs']:,}", program)


def _count(value: int | None) -> str:
    return "not known" if value is None else f"{value:,}"
