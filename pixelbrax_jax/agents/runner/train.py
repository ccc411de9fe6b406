"""A training run: iterations, and between them logs, evaluations and checkpoints."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from pixelbrax_jax.agents.core.algorithm import Algorithm, TrainState
from pixelbrax_jax.agents.core.config import describe
from pixelbrax_jax.agents.core.optimizer import Networks
from pixelbrax_jax.agents.runner.checkpoint import CheckpointError, Checkpoints
from pixelbrax_jax.agents.runner.evaluate import Evaluator, Result, interquartile_mean, make_splits
from pixelbrax_jax.agents.runner.export import save_policy
from pixelbrax_jax.agents.runner.interruption import StopRequest, stop_requests
from pixelbrax_jax.agents.runner.memory import check_memory
from pixelbrax_jax.agents.runner.metrics import MetricsWriter, NoWriter, together
from pixelbrax_jax.agents.runner.progress import Bar, Messages, reason
from pixelbrax_jax.agents.runner.run_config import RunConfig
from pixelbrax_jax.agents.runner.saving import Saver
from pixelbrax_jax.agents.runner.seeds import keys_of, of_seed, over_seeds
from pixelbrax_jax.agents.runner.sharding import anywhere, everywhere, highest, state_shardings
from pixelbrax_jax.compilation import compiler_options
from pixelbrax_jax.envs.pixel_env import PixelEnv
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
    """Trains to the end, or until it is interrupted.

    Ctrl-C, SIGTERM, or SIGHUP, lets the iteration finish, and one that waits behind it, writes a
    checkpoint and returns. What reports, draws or logs may fail without an effect on the training.

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
    folder = Path(options.output_dir)
    key = jax.random.key(options.seed)
    if options.seeds > 1:
        algorithm = over_seeds(algorithm)
        key = keys_of(options.seed, options.seeds)
    template = jax.eval_shape(algorithm.init, key, env_params)
    mesh: Mesh | None = getattr(algorithm.envs, "mesh", None)
    shardings, same = None, None
    if mesh is not None:
        shardings = state_shardings(mesh, template, options.seeds)
        same = NamedSharding(mesh, PartitionSpec())
        env_params = everywhere(mesh, env_params)
        template = jax.tree.map(
            lambda leaf, sharding: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding),
            template,
            shardings,
        )
    check_memory(algorithm, template, report)
    checkpoints = Checkpoints(
        folder / "checkpoints",
        _settings(algorithm, options),
        algorithm.name,
        keep=options.keep_checkpoints,
    )
    try:
        found = bool(checkpoints.steps())
        if anywhere(found) and anywhere(not found):
            raise CheckpointError(
                f"only some processes see checkpoints in {checkpoints.folder}; they must share "
                "--output-dir."
            )
        if options.resume == "latest" and found:
            state = checkpoints.restore(template)
            if others := checkpoints.other_versions():
                report(f"going on under other versions, so not to the bit: {', '.join(others)}")
            report(f"going on from the checkpoint of {_steps(algorithm, state)} steps")
        else:
            if found:
                raise FileExistsError(
                    f"{checkpoints.folder} has checkpoints of an earlier run: go on with "
                    "--resume latest, or give another --output-dir."
                )
            if options.resume == "latest":
                report(f"no checkpoint in {checkpoints.folder}: a new run begins")
            init = jax.jit(lambda params: algorithm.init(key, params), out_shardings=shardings)
            state = init(env_params)
        placed = None if mesh is None else (shardings, same)
        if options.num_evals and splits is None:
            splits = make_splits(algorithm.config)
        loop = _Run(algorithm, env_params, options, checkpoints, report, placed, splits or {}, stop)
        return loop.until_end(state)
    finally:
        checkpoints.close()


class _Run:
    """The loop over iterations."""

    def __init__(
        self,
        algorithm: Algorithm,
        env_params: EnvParams,
        options: RunConfig,
        checkpoints: Checkpoints,
        report: Messages,
        placed: Any,
        splits: Splits,
        stop: StopRequest,
    ) -> None:
        self._algorithm = algorithm
        self._config = algorithm.config
        self._params = env_params
        self._options = options
        self._checkpoints = checkpoints
        self._report = report
        self._stop = stop
        self._folder = Path(options.output_dir)
        self._first = jax.process_index() == 0
        # The state before an iteration is not needed after it: its memory is used again.
        compiled = partial(
            jax.jit, donate_argnums=0, out_shardings=placed, compiler_options=compiler_options()
        )
        self._iterate = compiled(algorithm.iterate)
        if algorithm.auxiliary is not None:
            self._auxiliary = compiled(algorithm.auxiliary)
        self._evaluators: dict[str, Evaluator] = {}
        if options.num_evals:
            for split, (env, params) in splits.items():
                self._evaluators[split] = Evaluator(
                    algorithm, env, params, num_episodes=options.eval_episodes
                )
        self._pending: list[dict[str, Any]] = []
        self._record: dict[str, float] = {}
        self._results: dict[str, Result] = {}

    def until_end(self, state: TrainState) -> Outcome:
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
                    {"algorithm": self._algorithm.name} | _settings(self._algorithm, self._options),
                    first_step=steps,
                    wandb_project=self._options.wandb_project,
                    report=self._report,
                )
            except (ImportError, OSError) as error:
                failure = error
        if anywhere(failure is not None):
            raise failure or RuntimeError("process 0 cannot write metrics; it says why.")
        return writer

    def _iterations(
        self, state: TrainState, steps: int, writer: MetricsWriter | NoWriter, bar: Bar
    ) -> tuple[TrainState, int, int]:
        """Trains to the end, or until a signal; the state, its steps, the signal's number or 0."""
        per_iteration, total = self._config.steps_per_iteration, self._config.num_iterations
        options, done = self._options, steps // self._config.steps_per_iteration
        bar.update(done)
        if done >= total:
            self._report(f"the run has had its {steps} steps")
            return state, steps, 0
        if stopped_by := highest(self._stop.signal)[0]:
            left = f"go on from {steps} steps with --resume latest" if steps else "nothing is lost"
            self._report(f"stopped before the first iteration; {left}")
            return state, steps, stopped_by
        self._report("compiling")
        saver = Saver(
            self._checkpoints,
            steps,
            self._report,
            every=options.checkpoint_every,
            minutes=options.checkpoint_minutes,
        )
        began, began_steps = time.perf_counter(), steps
        for number in range(done + 1, total + 1):
            state, steps = self._one(state, number), number * per_iteration
            bar.update(1)
            end = number == total
            # The clock is that of the first process.
            by_clock = self._first and saver.is_due_by_clock()
            stopped_by, due = highest(self._stop.signal, int(by_clock))
            stopped_by = 0 if end else stopped_by
            last = end or bool(stopped_by)
            evaluates = self._evaluates_after(number)
            saves = last or evaluates or bool(due) or saver.is_due_after(steps)
            logs = number % options.log_every == 0 or evaluates or saves
            if logs:
                self._settle(steps, saver)
                seconds = time.perf_counter() - began
                if options.log_training_metrics:
                    self._record["speed/steps_per_second"] = (steps - began_steps) / seconds
                    writer.write(steps, self._record)
                bar.update(0, self._record)
            if evaluates and not stopped_by:
                writer.write(steps, self._evaluate(state))
            if saves:
                score = self._score(evaluates and not stopped_by)
                saver.save(state, steps, score, last=last)
            else:
                saver.look_after()
            if logs:
                began, began_steps = time.perf_counter(), steps
            if stopped_by:
                # Whoever is asked to stop may soon be killed: first what is not to be lost.
                self._report(f"stopped after {steps} steps; go on with --resume latest")
                if evaluates:
                    writer.write(steps, self._evaluate(state))
                break
        return state, steps, stopped_by

    def _export(self, state: TrainState, steps: int) -> None:
        """Writes the policies.

        Raises:
            OSError: one cannot be written.
        """
        for networks, name in self._policies(state) if self._first else ():
            try:
                save_policy(self._algorithm, networks, self._folder / name)
            except OSError as error:
                raise OSError(
                    f"cannot write {self._folder / name}: {reason(error)}. The checkpoint of "
                    f"{steps} steps is whole: make room, and the same command with --resume latest "
                    "writes the policy at its end."
                ) from error

    def _one(self, state: TrainState, number: int) -> TrainState:
        """Iteration ``number``, from 1, and the auxiliary phase if it is due."""
        state, metrics = self._iterate(state, self._params)
        phases = self._algorithm.num_phases
        if phases and number % phases == 0:
            state, more = self._auxiliary(state)
            metrics |= more
        self._pending.append(metrics)
        # One iteration is under way and the next one waits; were there more, the bar would run
        # ahead and Ctrl-C would wait for all of them.
        jax.block_until_ready(self._pending[-2:-1])
        return state

    def _settle(self, steps: int, saver: Saver) -> None:
        """Puts the metrics of the latest iterations together, and looks at them.

        Raises:
            TrainingDivergedError: one is not finite.
        """
        if not self._pending:
            return
        records = jax.device_get(self._pending)
        self._pending = []
        for record in records:
            bad = {n: ~np.isfinite(value) for n, value in record.items()}
            bad = {n: where for n, where in bad.items() if where.any()}
            if bad:
                runs = ""
                if self._options.seeds > 1:
                    those = np.flatnonzero(np.any(list(bad.values()), axis=0))
                    names = (str(self._options.seed + int(i)) for i in those)
                    runs = f" of seed {', '.join(names)}"
                saver.look_after(wait=True)
                latest = saver.latest()
                kept = "there is none" if latest is None else f"that of {latest} steps is good"
                raise TrainingDivergedError(
                    f"not finite within the iterations before step {steps}{runs}: "
                    f"{', '.join(bad)}. Of the checkpoints {kept}. Begin anew in another "
                    "--output-dir; a lower learning_rate or max_grad_norm may help."
                )
        self._record = together(records)

    def _evaluates_after(self, number: int) -> bool:
        evals, total = self._options.num_evals, self._config.num_iterations
        return bool(evals) and number * evals // total > (number - 1) * evals // total

    def _policies(self, state: TrainState) -> Iterator[tuple[Networks, str]]:
        """Networks of each seed, and the name of its policy's file."""
        networks = jax.device_get(state.networks)
        if self._options.seeds == 1:
            yield networks, "policy.jax"
            return
        for i in range(self._options.seeds):
            yield of_seed(networks, i), f"policy_seed{self._options.seed + i}.jax"

    def _evaluate(self, state: TrainState) -> dict[str, float]:
        record = {}
        for split, evaluator in self._evaluators.items():
            runs = [evaluator(networks) for networks, _ in self._policies(state)]
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
        return record

    def _score(self, evaluated: bool) -> float | None:
        """By which the best checkpoint is chosen: one measure for all checkpoints of a run.

        It is the return in clean episodes of this moment, and without evaluations that of the
        latest training episodes.
        """
        if self._options.num_evals:
            return self._results["clean"].mean if evaluated else None
        return self._record.get("episode/return")


def _settings(algorithm: Algorithm, options: RunConfig) -> dict[str, Any]:
    """What decides the result of a run."""
    return describe(algorithm.config) | {"seed": options.seed, "seeds": options.seeds}


def _steps(algorithm: Algorithm, state: TrainState) -> int:
    """Control steps so far; all seeds are equally far."""
    return int(np.ravel(state.iteration)[0]) * algorithm.config.steps_per_iteration
