"""Returns of a suite's episodes: their files, and their table."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from pixelbrax_gym.bench.tables import table
from pixelbrax_jax.config import ENV_OPTIONS, EnvConfig
from pixelbrax_jax.generalisation.frames import write_sheet
from pixelbrax_jax.generalisation.intervals import interquartile_mean
from pixelbrax_jax.generalisation.making import UNDISTURBED, LevelEnv, Levels
from pixelbrax_jax.paths import make_folder, replacing
from pixelbrax_jax.plain import to_plain
from pixelbrax_jax.tasks import TASKS

RETURNS, ROWS, SHEET = "returns.json", "table.csv", "levels.png"
"""Files in the output folder."""

LEFT_OUT = ("task", *UNDISTURBED)
"""Options that a suite sets."""

ALL = "all but clean"
"""Name of the last row, of all levels but the first."""

Returns = dict[str, dict[str, list[float]]]
"""The returns of episodes by run and level."""


@dataclass(frozen=True)
class Row:
    """A line of the table: of a level, or the last one of all levels but clean.

    ``runs`` is the number R of seeds, with E ``episodes`` per level. ``mean`` is the mean
    return; for several runs the interquartile mean of their mean returns, in the last row over all
    levels. ``low`` and ``high`` are the ends of its 95 % stratified bootstrap interval, NaN for one
    run. ``standard_error`` is that of a run's mean over its episodes, averaged over runs; NaN for
    one episode and for the last row. ``ratio`` is ``mean`` divided by that of level clean; NaN if
    that is not positive. ``success`` is the share of all episodes with a return of at least
    ``success_return``; both are NaN without one.
    """

    level: str
    runs: int
    episodes: int
    mean: float
    low: float
    high: float
    standard_error: float
    ratio: float
    success: float
    success_return: float


@dataclass
class Scores:
    """The (E,) ``returns`` of a suite's episodes by run and level, and what determines them.

    An episode with at least ``success_return`` is a success. None takes the task's, if it has one
    and ``options`` have the usual rewards and length of episodes.
    """

    suite: str
    task: str
    options: dict[str, Any]
    returns: Returns = field(default_factory=dict)
    success_return: float | None = None

    def rows(self) -> list[Row]:
        """Return a row for each level that all runs have, and one for all but the first level.

        Rows have ``level``, ``runs``, ``episodes``, ``mean``, ``low``, ``high``,
        ``standard_error``, ``ratio`` (to clean), ``success`` and ``success_return``, or NaN.
        """
        runs = list(self.returns.values())
        names = [name for name in runs[0] if all(name in run for run in runs)] if runs else []
        arrays = {name: np.array([run[name] for run in runs], np.float64) for name in names}
        rows: list[Row] = []
        for name, returns in arrays.items():
            errors = np.full(len(runs), math.nan)
            if returns.shape[1] > 1:
                errors = returns.std(axis=1, ddof=1) / math.sqrt(returns.shape[1])
            rows.append(self._row(name, returns[None], float(errors.mean()), rows))
        if len(names) > 2:
            rows.append(self._row(ALL, np.stack([*arrays.values()][1:]), math.nan, rows))
        return rows

    def _row(self, name: str, returns: np.ndarray, error: float, rows: Sequence[Row]) -> Row:
        """Return the row of (S, R, E) returns of S levels."""
        low = high = math.nan
        threshold = rows[0].success_return if rows else self._threshold()
        success = math.nan if math.isnan(threshold) else float((returns >= threshold).mean())
        scores = returns.mean(axis=2)
        mean = float(scores.mean())
        if scores.shape[1] > 1:
            mean, low, high = interquartile_mean(scores)
        clean = rows[0].mean if rows else mean
        ratio = mean / clean if clean > 0 else math.nan
        episodes = int(self.options["episodes"])
        runs = scores.shape[1]
        return Row(name, runs, episodes, mean, low, high, error, ratio, success, threshold)

    def _threshold(self) -> float:
        if self.success_return is not None:
            return self.success_return
        task, usual = TASKS.get(self.task), EnvConfig()
        if task is None or task.success_return is None:
            return math.nan
        decisive = {name: getattr(usual, name) for name in ("episode_length", "reward_preset")}
        return task.success_return if decisive.items() <= self.options.items() else math.nan

    def markdown(self) -> str:
        """Return the table in Markdown."""
        rows = self.rows()
        several = len(self.returns) > 1
        heads = ["level", "return (IQM)" if several else "return"]
        heads += ["95 % interval"] if several else []
        heads += ["standard error", "ratio to clean"]
        succeeds = bool(rows) and not math.isnan(rows[0].success_return)
        heads += [f"success (from {rows[0].success_return:g})"] if succeeds else []
        lines = []
        for row in rows:
            interval = [f"{row.low:.1f} to {row.high:.1f}"] if several else []
            numbers = [_text(row.standard_error, 1), _text(row.ratio, 2)]
            numbers += [f"{row.success:.2f}"] if succeeds else []
            lines.append([row.level, f"{row.mean:.1f}", *interval, *numbers])
        return table(heads, lines)

    def csv(self) -> str:
        """Return the rows as CSV, with all digits."""
        text = io.StringIO()
        names = list(Row.__dataclass_fields__)
        writer = csv.DictWriter(text, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(row) for row in self.rows())
        return text.getvalue()


def _text(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def options_of(levels: Levels) -> dict[str, Any]:
    """Return what determines a policy's returns besides suite and task, as JSON values."""
    names = [name for name in ENV_OPTIONS if name not in LEFT_OUT]
    options = {name: to_plain(getattr(levels.config, name)) for name in names}
    bank = levels.bank
    shown = None if bank is None else f"{len(bank.names)} clips, {bank.digest[:16]}"
    return options | {"episodes": levels.episodes, "clips": shown}


def play(
    levels: Levels,
    players: Mapping[str, Callable[[LevelEnv], np.ndarray]],
    folder: str | PathLike[str] | None,
    report: Callable[[str], object],
    success_return: float | None = None,
) -> Scores:
    """Play all levels with all runs, functions that return the (E,) returns of a level.

    The folder gets the contact sheet first and the returns after each level; levels whose returns
    it has are not played again.
    """
    options = options_of(levels)
    scores = Scores(levels.suite, levels.config.task, options, success_return=success_return)
    path = None if folder is None else make_folder("output_dir", folder)
    known: Returns = {}
    if path is not None:
        known = read(scores, path)
        if not (known and (path / SHEET).exists()):
            write_sheet(levels, path / SHEET)
    for level in levels.levels:
        name = level.level.name
        for run, player in players.items():
            of_run = known.setdefault(run, {})
            is_new = name not in of_run
            if is_new:
                returns = np.asarray(player(level), np.float64)
                of_run[name] = returns.tolist()
                if path is not None:
                    # Another process may have added runs.
                    for other, found in read(scores, path).items():
                        known[other] = found | known.get(other, {})
                    with replacing(path / RETURNS) as part:
                        part.write_text(_json(scores, known), "utf-8")
            mean = float(np.mean(of_run[name]))
            report(f"{name}, {run}: return {mean:.1f}{'' if is_new else ', from the file'}")
    order = [level.level.name for level in levels.levels]
    scores.returns = {run: {name: known[run][name] for name in order} for run in players}
    if path is not None:
        with replacing(path / ROWS) as part:
            part.write_text(scores.csv(), "utf-8")
    return scores


def read(scores: Scores, folder: Path) -> Returns:
    """Return the returns in a folder, if any; ValueError for those of another suite or options."""
    file = folder / RETURNS
    if not file.exists():
        return {}
    try:
        found = json.loads(file.read_text("utf-8"))
        returns, _ = dict(found["returns"]), dict(found["options"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{file} has no returns of a suite; choose another folder.") from error
    wanted = json.loads(_json(scores, {}))
    there, here = ({**one, **one["options"]} for one in (found, wanted))
    for name in [*here, *there]:
        if name in ("returns", "options") or there.get(name) == here.get(name):
            continue
        raise ValueError(
            f"{file} has {name}={there.get(name)!r}, this call {here.get(name)!r}: its levels "
            "cannot be taken over. Choose another folder, or delete the file."
        )
    return returns


def _json(scores: Scores, returns: Mapping[str, Any]) -> str:
    kept = asdict(scores) | {"returns": returns}
    del kept["success_return"]
    return json.dumps(kept) + "\n"
