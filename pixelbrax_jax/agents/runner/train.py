"""A training run: iterations, and between them logs, evaluations and checkpoints."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.runner import programs
from pixelbrax_jax.agents.runner.checkpoint import CheckpointError, Checkpoints
from pixelbrax_jax.agents.runner.evaluate import Evaluator, Result, interquartile_mean, make_splits
from pixelbrax_jax.agents.runner.export import save_policy
from pixelbrax_jax.agents.runner.interruption import StopRequest, stop_requests
from pixelbrax_jax.agents.runner.memory import check_memory
from pixelbrax_jax.agents.runner.metrics import MetricsWriter, NoWriter, summarize
from pixelbrax_jax.agents.runner.progress import Bar, Messages, reason
from pixelbrax_jax.agents.runner.run_config import RunConfig
from pixelbrax_jax.agents.runner.saving import Saver
from pixelbrax_jax.agents.runner.schedule import Schedule
from pixelbrax_jax.agents.runner.seeds import Runs
from pixelbrax_jax.agents.runner.settings import (
    clip_digests,
    former_settings,
    settings_of,
    stored_clips,
)
from pixelbrax_jax.agents.runner.sharding import (
    any_process,
    highest,
    mesh_of,
    replicate,
    state_shardings,
)
from pixelbrax_jax.agents.train_state import TrainState, kept, parts_not_kept
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.stop_signals import signal_name
from pixelbrax_jax.types import EnvParams

__all__ = ["Outcome", "RunConfig", "TrainingDivergedError", "run"]

Splits = dict[str, tuple[PixelEnv, EnvParams]]
"""Environments to evaluate in, and their parameters, by name."""


class TrainingDivergedError(RuntimeError):
    """A loss or a gradient is not finite."""


@dataclass(frozen=True)
class Outcome:
    """What a run leaves.

    Attributes:
        state: where training stands.
        metrics: the last record of the training; empty if none was logged.
        evaluations: the last results, by split.
        interrupted: whether it was stopped before its end.
        signal: number of the signal that stopped it; 0 if none did.
        incomplete: what of the messages and records could not be written, and why, in lines.
    """

    state: TrainState
    metrics: dict[str, float]
    evaluations: dict[str, Result]
    interrupted: bool
    signal: int = 0
    incomplete: tuple[str, ...] = ()


def _silent(line: str) -> None:
    del line


def run(
    algorithm: Algorithm,
    env_params: EnvParams,
    options: RunConfig,
    *,
    report: Callable[[str], None] = _silent,
    splits: Splits | None = None,
) -> Outcome:
    """Train to the end, or until it is interrupted.

    Ctrl-C, or a signal of ``stop_signals``, lets the iteration finish, and one that waits behind
    it, writes a checkpoint and returns. What reports, draws or logs may fail without an effect on
    the training.

    Args:
        algorithm: with its settings.
        env_params: of its environments.
        options: what is done around it.
        report: gets lines about what is going on; it may raise.
        splits: environments to evaluate in, with their parameters, by name; one is ``"clean"``,
            which chooses the best checkpoint. None makes those that the settings name, which
            environments of your own are not.

    Raises:
        CheckpointError: the folder cannot be written to, or holds another run, or the last
            checkpoint cannot be written.
        OSError: files of records cannot be opened, or the policy cannot be written.
        MemoryError: what must be stored would not fit.
        TrainingDivergedError: a loss is not finite; the last good checkpoint stays.
    """
    messages = Messages(report)
    with stop_requests(report) as stop:
        return _run(algorithm, env_params, options, messages, splits, stop)


def _run(
    algorithm: Algorithm,
    env_params: EnvParams,
    options: RunConfig,
    report: Messages,
    splits: Splits | None,
    stop: StopRequest,
) -> Outcome:
    runs, mesh = Runs(algorithm, options.seeds), mesh_of(algorithm)
    seed, shown = jax.device_put(np.uint32(options.seed)), clip_digests(env_params.clips)
    if mesh is not None:
        env_params = replicate(mesh, env_params)
    template = jax.eval_shape(runs.init, seed, env_params)
    if mesh is not None:
        template = jax.tree.map(
            lambda leaf, sharding: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding),
            template,
            state_shardings(mesh, template, options.seeds),
        )
    check_memory(algorithm, template, report)
    checkpoints = Checkpoints(
        Path(options.output_dir) / "checkpoints",
        settings_of(algorithm, options),
        algorithm.name,
        keep=options.keep_checkpoints,
        former=former_settings(type(algorithm.config)),
        clips=stored_clips(algorithm.config, shown),
    )
    try:
        if _goes_on(checkpoints, options, report):
            state = checkpoints.restore(kept(template))
            if left_out := parts_not_kept(state):
                fresh = programs.init(runs, seed, env_params)
                state = state.replace(**{name: getattr(fresh, name) for name in left_out})
            if others := checkpoints.other_versions():
                report(f"going on under other versions, so not to the bit: {', '.join(others)}")
            report(f"going on from the checkpoint of {_steps(algorithm, state)} steps")
        else:
            state = programs.init(runs, seed, env_params)
        if options.num_evals and splits is None:
            splits = make_splits(algorithm.config, shown, report)
        return _Run(runs, env_params, options, checkpoints, report, splits or {}, stop).train(state)
    finally:
        checkpoints.close()


def _goes_on(checkpoints: Checkpoints, options: RunConfig, report: Messages) -> bool:
    """Return whether the run goes on from a checkpoint.

    Raises:
        FileExistsError: there is one of an earlier run.
        CheckpointError: only some processes see it.
    """
    found = bool(checkpoints.steps())
    if any_process(found) and any_process(not found):
        raise CheckpointError(
            f"only some processes see checkpoints in {checkpoints.folder}; they must share "
            "--output-dir."
        )
    if found and options.resume != "latest":
        raise FileExistsError(
            f"{checkpoints.folder} has checkpoints of an earlier run: go on with "
            "--resume latest, or give another --output-dir."
        )
    if not found and options.resume == "latest":
        report(f"no checkpoint in {checkpoints.folder}: a new run begins")
    return found


class _Run:
    """One call of `run`: the loop over iterations, and what follows each."""

    def __init__(
        self,
        runs: Runs,
        env_params: EnvParams,
        options: RunConfig,
        checkpoints: Checkpoints,
        report: Messages,
        splits: Splits,
        stop: StopRequest,
    ) -> None:
        self._runs = runs
        self._algorithm = runs.algorithm
        self._config = runs.algorithm.config
        self._params = env_params
        self._options = options
        self._checkpoints = checkpoints
        self._report = report
        self._stop = stop
        self._folder = Path(options.output_dir)
        self._schedule = Schedule(
            self._config.num_iterations,
            runs.algorithm.auxiliary_every,
            options.log_every,
            options.num_evals,
        )
        self._first = jax.process_index() == 0
        self._evaluators: dict[str, Evaluator] = {}
        if options.num_evals:
            for split, (env, params) in splits.items():
                self._evaluators[split] = Evaluator(
                    runs.algorithm, env, params, num_episodes=options.eval_episodes
                )
        self._pending: list[dict[str, Any]] = []
        self._record: dict[str, float] = {}
        self._results: dict[str, Result] = {}
        self._evaluated_steps = -1
        self._timed_steps, self._timed_since = 0, 0.0

    def train(self, state: TrainState) -> Outcome:
        """Train from ``state`` to the end, or until a signal."""
        began = steps = _steps(self._algorithm, state)
        total = self._config.num_iterations
        writer = self._open_writer(steps)
        try:
            bar = Bar(self._options.progress and self._first, total, self._report)
            with closing(bar):
                state, steps, stopped_by = self._iterations(state, steps, writer, bar)
            if not stopped_by or steps > began:
                self._export(state, steps)
        finally:
            writer.close()
            for line in (missing := writer.missing()):
                self._report(line)
        if not stopped_by:
            self._report(f"done after {steps} steps; checkpoints and policy in {self._folder}")
        failed = {"the progress bar": bar.failure, "messages": self._report.failure}
        incomplete = [f"{name} could not be shown: {why}" for name, why in failed.items() if why]
        return Outcome(
            state,
            self._record,
            self._results,
            bool(stopped_by),
            stopped_by,
            (*missing, *incomplete),
        )

    def _open_writer(self, steps: int) -> MetricsWriter | NoWriter:
        writer: MetricsWriter | NoWriter = NoWriter()
        failure: Exception | None = None
        if self._first:
            try:
                writer = MetricsWriter(
                    self._folder,
                    {"algorithm": self._algorithm.name}
                    | settings_of(self._algorithm, self._options),
                    first_step=steps,
                    wandb_project=self._options.wandb_project,
                    report=self._report,
                )
            except (ImportError, OSError) as error:
                failure = error
        if any_process(failure is not None):
            raise failure or RuntimeError("process 0 cannot write metrics; it says why.")
        return writer

    def _iterations(
        self, state: TrainState, steps: int, writer: MetricsWriter | NoWriter, bar: Bar
    ) -> tuple[TrainState, int, int]:
        """Train to the end, or until a signal.

        Returns:
            The state, its steps, and the signal's number or 0.
        """
        per_iteration, total = self._config.steps_per_iteration, self._config.num_iterations
        done = steps // per_iteration
        bar.update(done)
        if done >= total:
            self._report(f"the run has had its {steps} steps")
            return state, steps, 0
        if stopped_by := highest(self._stop.signal)[0]:
            left = f"go on from {steps} steps with --resume latest" if steps else "nothing is lost"
            self._report(f"stopped by {signal_name(stopped_by)} before the first iteration; {left}")
            return state, steps, stopped_by
        self._report("compiling")
        saver = Saver(
            self._checkpoints,
            steps,
            self._report,
            every=self._options.checkpoint_every,
            minutes=self._options.checkpoint_minutes,
        )
        self._restart_timer(steps)
        for number in range(done + 1, total + 1):
            state, steps = self._iterate(state, number), number * per_iteration
            bar.update(1)
            # The clock is that of the first process.
            by_clock = self._first and saver.is_due_by_clock()
            stopped_by, due = highest(self._stop.signal, int(by_clock))
            stopped_by = 0 if number == total else stopped_by
            jobs = self._schedule.jobs(
                number, save=bool(due) or saver.is_due_after(steps), stop=bool(stopped_by)
            )
            for job in jobs:
                match job:
                    case "log":
                        self._log(steps, writer, bar, saver)
                    case "evaluate":
                        writer.write(steps, self._evaluate(state, steps))
                    case "save":
                        last = number == total or bool(stopped_by)
                        saver.save(kept(state), steps, self._score(steps), last=last)
                    case "report_stop":
                        self._report(
                            f"stopped by {signal_name(stopped_by)} after {steps} steps; go on with "
                            "--resume latest"
                        )
            if "save" not in jobs:
                saver.look_after()
            if jobs:
                self._restart_timer(steps)
            if stopped_by:
                break
        return state, steps, stopped_by

    def _iterate(self, state: TrainState, number: int) -> TrainState:
        """Run iteration ``number``, and the auxiliary phase if it is due."""
        state, metrics = programs.iterate(self._runs, state, self._params)
        if self._schedule.has_auxiliary_phase(number):
            state, aux_metrics = programs.auxiliary(self._runs, state)
            metrics |= aux_metrics
        self._pending.append(metrics)
        # One iteration is under way and the next one waits; were there more, the bar would run
        # ahead and Ctrl-C would wait for all of them.
        jax.block_until_ready(self._pending[-2:-1])
        return state

    def _restart_timer(self, steps: int) -> None:
        self._timed_since, self._timed_steps = time.perf_counter(), steps

    def _log(self, steps: int, writer: MetricsWriter | NoWriter, bar: Bar, saver: Saver) -> None:
        """Write the metrics of the latest iterations.

        Raises:
            TrainingDivergedError: one is not finite.
        """
        if self._pending:
            records = jax.device_get(self._pending)
            self._pending = []
            for record in records:
                self._check_finite(record, steps, saver)
            self._record = summarize(records)
        if self._options.log_training_metrics:
            seconds = time.perf_counter() - self._timed_since
            self._record["speed/steps_per_second"] = (steps - self._timed_steps) / seconds
            writer.write(steps, self._record)
        bar.update(0, self._record)

    def _check_finite(self, record: dict[str, Any], steps: int, saver: Saver) -> None:
        wrong = {name: ~np.isfinite(value) for name, value in record.items()}
        wrong = {name: where for name, where in wrong.items() if where.any()}
        if not wrong:
            return
        seeds = ""
        if self._options.seeds > 1:
            those = np.flatnonzero(np.any(list(wrong.values()), axis=0))
            names = (str(self._options.seed + int(i)) for i in those)
            seeds = f" of seed {', '.join(names)}"
        saver.look_after(wait=True)
        latest = saver.latest()
        kept = "there is none" if latest is None else f"that of {latest} steps is good"
        raise TrainingDivergedError(
            f"not finite within the iterations before step {steps}{seeds}: {', '.join(wrong)}. Of "
            f"the checkpoints {kept}. Begin anew in another --output-dir; a lower learning_rate or "
            "max_grad_norm may help."
        )

    def _export(self, state: TrainState, steps: int) -> None:
        """Write the policies.

        Raises:
            OSError: one cannot be written.
        """
        if not self._first:
            return
        for i, networks in enumerate(self._runs.split(jax.device_get(state.networks))):
            several = self._runs.num_seeds > 1
            name = f"policy_seed{self._options.seed + i}.jax" if several else "policy.jax"
            try:
                save_policy(self._algorithm, networks, self._folder / name)
            except OSError as error:
                raise OSError(
                    f"cannot write {self._folder / name}: {reason(error)}. The checkpoint of "
                    f"{steps} steps is whole: make room, and the same command with --resume latest "
                    "writes the policy at its end."
                ) from error

    def _evaluate(self, state: TrainState, steps: int) -> dict[str, float]:
        """Evaluate each run in each split, and return what is logged of it."""
        record = {}
        policies = self._runs.split(jax.device_get(state.networks))
        for split, evaluator in self._evaluators.items():
            runs = [evaluator(networks) for networks in policies]
            if len(runs) > 1:
                middle = interquartile_mean(np.array([run.mean for run in runs]))
                for number, run in enumerate(runs):
                    record[f"eval/{split}/return/run_{number}"] = run.mean
                record[f"eval/{split}/iqm"] = middle.value
                record[f"eval/{split}/iqm_low"] = middle.low
                record[f"eval/{split}/iqm_high"] = middle.high
            result = self._results[split] = Result(
                returns=np.concatenate([run.returns for run in runs]),
                lengths=np.concatenate([run.lengths for run in runs]),
            )
            record[f"eval/{split}/return"] = result.mean
            record[f"eval/{split}/length"] = float(result.lengths.mean())
            line = f"{split}: return {result.mean:.1f}"
            if len(result.returns) > 1:
                record[f"eval/{split}/standard_error"] = result.standard_error
                line += f" +- {result.standard_error:.1f} (standard error)"
            self._report(line)
        self._evaluated_steps = steps
        return record

    def _score(self, steps: int) -> float | None:
        """Return by what the best checkpoint is chosen: one measure for all those of a run.

        It is the return in clean episodes of this moment, and without evaluations that of the
        latest training episodes.
        """
        if self._options.num_evals:
            return self._results["clean"].mean if self._evaluated_steps == steps else None
        return self._record.get("episode/return")


def _steps(algorithm: Algorithm, state: TrainState) -> int:
    """Return the control steps so far; all seeds are equally far."""
    return int(np.ravel(state.iteration)[0]) * algorithm.config.steps_per_iteration
