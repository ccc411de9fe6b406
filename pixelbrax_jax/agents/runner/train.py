"""Train an algorithm with logs, evaluations and checkpoints."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from signal import Signals
from typing import Any

import flatbuffers  # noqa: F401  # exports the policy at the end
import jax
import numpy as np

from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.config import TrainConfig, make_env
from pixelbrax_jax.agents.registry import make_algorithm
from pixelbrax_jax.agents.runner.checkpoint import CheckpointError, Checkpoints, latest_steps
from pixelbrax_jax.agents.runner.devices import (
    any_process,
    check_memory,
    highest,
    mesh_of,
    replicate,
)
from pixelbrax_jax.agents.runner.evaluate import Evaluator, Result, together
from pixelbrax_jax.agents.runner.metrics import MetricsWriter, open_metrics, summarize
from pixelbrax_jax.agents.runner.programs import Runs
from pixelbrax_jax.agents.runner.progress import Bar, Messages, Report, reason, silent
from pixelbrax_jax.agents.runner.settings import (
    RunConfig,
    clip_digests,
    describe_run,
    former_settings,
)
from pixelbrax_jax.agents.runner.splits import make_splits
from pixelbrax_jax.agents.runner.trained import save_policy
from pixelbrax_jax.agents.train_state import TrainState, kept, parts_not_kept
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.envs.sharded import ShardedVectorEnv, make_env_mesh
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.stop_signals import StopRequest, stop_requests
from pixelbrax_jax.types import EnvParams


class TrainingDivergedError(RuntimeError):
    """A loss or a gradient is not finite."""


@dataclass(frozen=True)
class Outcome:
    """The result of a run.

    Attributes:
        metrics: the last record of the training, or empty.
        evaluations: the last results by split.
        signal: number of the signal that stopped the run, or 0.
        incomplete: lines about messages and records that could not be written.
    """

    state: TrainState
    metrics: dict[str, float]
    evaluations: dict[str, Result]
    signal: int = 0
    incomplete: tuple[str, ...] = ()


def train(config: TrainConfig, options: RunConfig, report: Report = silent) -> Outcome:
    """Make the environments of the settings on all devices, and `run` the algorithm."""
    env, env_params = make_env(config)
    devices = jax.device_count()
    envs: Any = VectorPixelEnv(env, config.num_envs)
    if devices > 1:
        envs = ShardedVectorEnv(env, config.num_envs, make_env_mesh())
    algorithm = make_algorithm(config, envs)
    Messages(report)(
        f"{algorithm.name} on {config.env.task}, {config.num_envs} environments, {devices} "
        f"{jax.default_backend()} device{'s' * (devices > 1)}, {config.num_iterations} "
        f"iterations of {config.steps_per_iteration} control steps; "
        f"into {Path(options.output_dir).resolve()}"
    )
    return run(algorithm, env_params, options, report=report)


def run(
    algorithm: Algorithm,
    env_params: EnvParams,
    options: RunConfig,
    *,
    report: Report = silent,
    splits: dict[str, tuple[PixelEnv, EnvParams]] | None = None,
) -> Outcome:
    """Train to the end or until an interruption.

    After Ctrl-C or another signal of ``stop_signals``, the run finishes the current iterations,
    writes a checkpoint and returns. Errors of messages and logs do not affect the training.
    ``splits`` are evaluation environments with their parameters, by name: ``"clean"`` is required
    and selects the best checkpoint. None makes the environments of the settings.

    Raises:
        CheckpointError: checkpoints cannot be written, or the folder has another or a longer run.
        FileExistsError: the folder has a run, and ``options.resume`` is not ``"latest"``.
        ValueError: ``splits`` are given without ``"clean"``.
        TrainingDivergedError: a metric is not finite.
    """
    if splits and "clean" not in splits:
        raise ValueError(f"splits must have 'clean', got {', '.join(splits)}.")
    messages = Messages(report)
    with stop_requests(report) as stop:
        runs, mesh = Runs(algorithm, options.seeds), mesh_of(algorithm)
        shown = clip_digests(env_params.clips)
        if mesh is not None:
            env_params = replicate(mesh, env_params)
        template = runs.template(env_params)
        check_memory(algorithm, template, messages)
        checkpoints = Checkpoints(
            Path(options.output_dir) / "checkpoints",
            describe_run(algorithm, options, shown),
            keep=options.keep_checkpoints,
            former=former_settings(type(algorithm.config)),
            every=options.checkpoint_every,
            minutes=options.checkpoint_minutes,
            report=messages,
        )
        with closing(checkpoints):
            seed = jax.device_put(np.uint32(options.seed))
            if _goes_on(checkpoints, options, messages):
                state = _restored(checkpoints, template, algorithm, messages)
                if left_out := parts_not_kept(state):
                    messages(_filled_anew(left_out, state, algorithm.config))
                    fresh = runs.init(seed, env_params)
                    state = state.replace(**{name: getattr(fresh, name) for name in left_out})
            else:
                state = runs.init(seed, env_params)
            if not options.num_evals:
                splits = {}
            elif splits is None:
                splits = dict(make_splits(algorithm.config, shown=shown, report=messages))
            evaluators = {
                name: Evaluator(algorithm, env, params, num_episodes=options.eval_episodes)
                for name, (env, params) in splits.items()
            }
            one = _Run(runs, env_params, options, checkpoints, messages, stop, evaluators)
            return one.train(state)


def _filled_anew(parts: Sequence[str], state: TrainState, config: TrainConfig) -> str:
    """Say which parts of the state are refilled, and whether enough steps are left for it."""
    iterations, needed = config.num_iterations - _iterations(state), config.steps_to_fill
    steps = iterations * config.steps_per_iteration // config.env.action_repeat
    then = "filled anew before learning goes on"
    if 0 < steps < needed:
        then = (
            f"filling it takes the first {needed} of the agent's steps, and only {steps} are left, "
            "so nothing more is learned; raise total_steps"
        )
    return f"not in the checkpoint: {', '.join(parts)}; {then}"


def _goes_on(checkpoints: Checkpoints, options: RunConfig, report: Report) -> bool:
    """Return whether the run continues from a checkpoint, or raise if it may not."""
    found = latest_steps(checkpoints.folder) is not None
    if any_process(found) and any_process(not found):
        raise CheckpointError(
            f"only some processes see checkpoints in {checkpoints.folder}; they must share "
            "--output-dir."
        )
    if found and options.resume != "latest":
        raise FileExistsError(
            f"{checkpoints.folder} has checkpoints of an earlier run: continue it with "
            "--resume latest, or use another --output-dir."
        )
    if not found and options.resume == "latest":
        report(f"no checkpoint in {checkpoints.folder}: starting a new run")
    return found


def _restored(
    checkpoints: Checkpoints, template: TrainState, algorithm: Algorithm, report: Report
) -> TrainState:
    """Restore the latest checkpoint, or raise if it is from another run."""
    state, config = checkpoints.restore(kept(template)), algorithm.config
    iterations = _iterations(state)
    steps = iterations * config.steps_per_iteration
    if iterations > config.num_iterations:
        raise CheckpointError(
            f"total_steps={config.total_steps} must be at least {steps}, the steps already "
            f"trained in {checkpoints.folder}; raise total_steps, or use another --output-dir."
        )
    if others := checkpoints.other_versions():
        report(f"continuing with other versions, so not bit-exactly: {', '.join(others)}")
    report(f"continuing from the checkpoint of {steps} steps")
    return state


@dataclass
class _Run:
    """The state of one call of `run`."""

    runs: Runs
    env_params: EnvParams
    options: RunConfig
    checkpoints: Checkpoints
    report: Messages
    stop: StopRequest
    evaluators: dict[str, Evaluator]
    pending: list[dict[str, Any]] = field(default_factory=list)
    """Metrics of iterations since the last record."""
    record: dict[str, float] = field(default_factory=dict)
    results: dict[str, Result] = field(default_factory=dict)
    warned: bool = False
    since: tuple[float, int] = (0.0, 0)
    """Time and steps at the last record."""
    ended: tuple[float, float] = (0.0, 0.0)
    """Sum of the returns, and number, of training episodes since the last checkpoint."""

    def __post_init__(self) -> None:
        self.algorithm = self.runs.algorithm
        self.config = self.algorithm.config
        self.folder = Path(self.options.output_dir)
        self.is_first = jax.process_index() == 0

    def train(self, state: TrainState) -> Outcome:
        began = _iterations(state)
        self.writer = self.open_writer(began * self.config.steps_per_iteration)
        try:
            shown = self.options.progress and self.is_first
            self.bar = Bar(shown, self.config.num_iterations, self.report)
            with closing(self.bar):
                state, stopped_by = self.iterations(state, began)
            steps = _iterations(state) * self.config.steps_per_iteration
            if self.is_first and (not stopped_by or _iterations(state) > began):
                self.export(state, steps)
        finally:
            self.writer.close()
            for line in (missing := self.writer.missing()):
                self.report(line)
        if not stopped_by:
            self.report(f"done after {steps} steps; checkpoints and policy in {self.folder}")
        failed = {"the progress bar": self.bar.failure, "messages": self.report.failure}
        hidden = [f"{name} could not be shown: {why}" for name, why in failed.items() if why]
        return Outcome(state, self.record, self.results, stopped_by, (*missing, *hidden))

    def open_writer(self, steps: int) -> MetricsWriter:
        """Open the logs in the first process; an error raises in all processes."""
        writer, failure = MetricsWriter(self.report), None
        if self.is_first:
            settings = describe_run(self.algorithm, self.options)["config"]
            try:
                writer = open_metrics(
                    self.folder,
                    {"algorithm": self.algorithm.name} | settings,
                    self.report,
                    first_step=steps,
                    wandb_project=self.options.wandb_project,
                )
            except (ImportError, OSError) as error:
                failure = error
        if any_process(failure is not None):
            raise failure or RuntimeError("process 0 cannot write metrics; see its message.")
        return writer

    def iterations(self, state: TrainState, done: int) -> tuple[TrainState, int]:
        """Train to the end or to a signal; return the state, and the signal's number or 0."""
        per_iteration, total = self.config.steps_per_iteration, self.config.num_iterations
        steps = done * per_iteration
        self.bar.update(done)
        if done >= total:
            self.report(f"the run is already complete with {steps} steps")
            return state, 0
        if stopped_by := highest(self.stop.signal)[0]:
            left = (
                f"continue from {steps} steps with --resume latest" if steps else "nothing is lost"
            )
            self.report(f"stopped by {Signals(stopped_by).name} before the first iteration; {left}")
            return state, stopped_by
        self.report("compiling")
        self.since = time.perf_counter(), steps
        for number in range(done + 1, total + 1):
            state, steps = self.iterate(state, number), number * per_iteration
            self.bar.update(1)
            # The clock of the first process decides.
            by_clock = self.is_first and self.checkpoints.is_due_by_clock()
            stopped_by, due = highest(self.stop.signal, int(by_clock))
            stopped_by = 0 if number == total else stopped_by
            last = number == total or bool(stopped_by)
            evaluates = is_due(number, self.options.num_evals, total)
            saves = last or evaluates or bool(due) or self.checkpoints.is_due_after(steps)
            logs = saves or number % self.options.log_every == 0
            if logs:
                self.log(steps)
            score = None if self.options.num_evals else self.mean_return()
            if evaluates and not stopped_by:
                self.evaluate(state, steps)
                score = self.results["clean"].mean
            if saves:
                self.checkpoints.save(kept(state), steps, score, last=last)
                self.ended = 0.0, 0.0
            else:
                self.checkpoints.look_after()
            if stopped_by:
                self.report(
                    f"stopped by {Signals(stopped_by).name} after {steps} steps; continue with "
                    "--resume latest"
                )
                # Comes after the checkpoint, because the process may soon be killed.
                if evaluates:
                    self.evaluate(state, steps)
                break
            if logs:
                self.since = time.perf_counter(), steps
        return state, stopped_by

    def iterate(self, state: TrainState, number: int) -> TrainState:
        state, metrics = self.runs.iterate(state, self.env_params)
        phases = self.algorithm.auxiliary_every
        if phases and number % phases == 0:
            state, aux_metrics = self.runs.auxiliary(state)
            metrics |= aux_metrics
        self.pending.append(metrics)
        # At most one iteration waits behind the running one. With more, the bar would run ahead
        # and Ctrl-C would wait for all of them.
        jax.block_until_ready(self.pending[-2:-1])
        return state

    def log(self, steps: int) -> None:
        """Write the metrics since the last record, or raise a TrainingDivergedError."""
        records, self.pending = jax.device_get(self.pending), []
        for record in records:
            self.check_finite(record, steps)
        self.record = summarize(records)
        mean, count = (self.record.get(f"episode/{name}", 0.0) for name in ("return", "count"))
        self.ended = self.ended[0] + mean * count, self.ended[1] + count
        if not self.warned:
            for line in self.algorithm.warnings(self.record):
                self.report(line)
                self.warned = True
        if self.options.log_training_metrics:
            then, steps_then = self.since
            speed = (steps - steps_then) / (time.perf_counter() - then)
            self.record["speed/steps_per_second"] = speed
            self.writer.write(steps, self.record)
        if "episode/return" in self.record:
            self.bar.set_postfix(episode_return=f"{self.record['episode/return']:.1f}")

    def mean_return(self) -> float | None:
        """Return the mean return of training episodes since the last checkpoint, if any ended."""
        total, count = self.ended
        return total / count if count else None

    def check_finite(self, record: dict[str, Any], steps: int) -> None:
        wrong = {name: ~np.isfinite(value) for name, value in record.items()}
        wrong = {name: where for name, where in wrong.items() if where.any()}
        if not wrong:
            return
        seeds = ""
        if self.options.seeds > 1:
            those = np.flatnonzero(np.any(list(wrong.values()), axis=0))
            seeds = f" of seed {', '.join(str(self.options.seed + int(i)) for i in those)}"
        self.checkpoints.look_after(wait=True)
        latest = latest_steps(self.checkpoints.folder)
        good = (
            "No checkpoint exists"
            if latest is None
            else f"The checkpoint of {latest} steps is good"
        )
        raise TrainingDivergedError(
            f"not finite in the iterations before step {steps}{seeds}: {', '.join(wrong)}. "
            f"{good}. Train again in another --output-dir; a lower learning_rate or "
            "max_grad_norm may help."
        )

    def evaluate(self, state: TrainState, steps: int) -> None:
        record: dict[str, float] = {}
        policies = self.runs.split(jax.device_get(state.networks))
        for split, evaluator in self.evaluators.items():
            result, logged = together([evaluator(networks) for networks in policies])
            self.results[split] = result
            record |= {f"eval/{split}/{name}": value for name, value in logged.items()}
            line = f"{split}: return {result.mean:.1f}"
            if "standard_error" in logged:
                line += f" +- {result.standard_error:.1f} (standard error)"
            self.report(line)
        self.writer.write(steps, record)

    def export(self, state: TrainState, steps: int) -> None:
        for i, networks in enumerate(self.runs.split(jax.device_get(state.networks))):
            several = self.runs.num_seeds > 1
            name = f"policy_seed{self.options.seed + i}.jax" if several else "policy.jax"
            try:
                save_policy(self.algorithm, networks, self.folder / name)
            except OSError as error:
                raise OSError(
                    f"cannot write {self.folder / name}: {reason(error)}. The checkpoint of "
                    f"{steps} steps is complete: free disk space and repeat the command with "
                    "--resume latest to write the policy."
                ) from error


def is_due(number: int, times: int, total: int) -> bool:
    """Return whether one of ``times`` events, evenly over ``total``, is due after ``number``."""
    return number * times // total > (number - 1) * times // total


def _iterations(state: TrainState) -> int:
    """Return the number of iterations so far, which is equal for all seeds."""
    return int(np.ravel(state.iteration)[0])
