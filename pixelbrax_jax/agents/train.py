"""A training run: iterations, and between them logs, evaluations and checkpoints."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from pixelbrax_jax.agents.algorithm import Algorithm, TrainState
from pixelbrax_jax.agents.checkpoint import CheckpointError, Checkpoints
from pixelbrax_jax.agents.config import check_count, describe
from pixelbrax_jax.agents.evaluate import Evaluator, Result, interquartile_mean, make_splits
from pixelbrax_jax.agents.export import save_policy
from pixelbrax_jax.agents.memory import check_memory
from pixelbrax_jax.agents.metrics import MetricsWriter, NoWriter, together
from pixelbrax_jax.agents.optimizer import Networks
from pixelbrax_jax.agents.seeds import keys_of, of_seed, over_seeds
from pixelbrax_jax.agents.sharding import anywhere, everywhere, state_shardings
from pixelbrax_jax.choices import check_choice, check_whole
from pixelbrax_jax.compilation import compiler_options
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.types import EnvParams

RESUME = ("never", "latest")

Splits = dict[str, tuple[PixelEnv, EnvParams]]
"""Environments to evaluate in, and their parameters, by name."""


@dataclass(frozen=True)
class RunConfig:
    """What is done around the training; nothing but the seeds changes a bit of it."""

    output_dir: str = "runs/train"
    """Folder of logs, checkpoints and the policy."""
    seed: int = 0
    """Seed of the run."""
    seeds: int = 1
    """Runs in one program, of the seeds ``seed``, ``seed`` + 1, ..."""
    resume: str = "never"
    """``latest`` goes on from the latest checkpoint in the folder, if there is one."""
    log_training_metrics: bool = True
    """Whether metrics of the training itself are logged."""
    log_every: int = 1
    """Iterations that one record sums up."""
    num_evals: int = 0
    """Evaluations, evenly over the run, the last at its end; 0 never makes such environments."""
    eval_episodes: int = 32
    """Episodes of an evaluation, for each split."""
    checkpoint_every: int = 0
    """Control steps between checkpoints; 0 writes them at evaluations and at the end only."""
    keep_checkpoints: int = 3
    """Latest checkpoints that are kept, besides the best."""
    wandb_project: str | None = None
    """Project of Weights & Biases; none writes nothing there."""
    progress: bool = True
    """Whether a progress bar is shown."""

    def __post_init__(self) -> None:
        """Checks the settings.

        Raises:
            ValueError: a setting is out of range; the message says what is allowed.
        """
        check_choice("resume", self.resume, RESUME)
        for name in ("seeds", "log_every", "eval_episodes", "keep_checkpoints"):
            check_whole(name, getattr(self, name))
        for name in ("seed", "num_evals", "checkpoint_every"):
            check_count(name, getattr(self, name))
        if self.seed + self.seeds > 2**32:
            raise ValueError(
                f"seeds must be below 2**32, got seed={self.seed} and seeds={self.seeds}."
            )


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
    """

    state: TrainState
    metrics: dict[str, float]
    evaluations: dict[str, Result]
    interrupted: bool


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

    Ctrl-C, or SIGTERM, lets the iteration finish, and one that waits behind it, writes a
    checkpoint and returns.

    Args:
        algorithm: with its settings.
        env_params: of its environments.
        options: what is done around it.
        report: gets lines about what is going on.
        splits: environments to evaluate in, with their parameters, by name; one is ``"clean"``,
            which chooses the best checkpoint. None makes those that the settings name, which
            environments of your own are not.

    Raises:
        CheckpointError: the folder cannot be written to, or holds another run.
        MemoryError: what must be stored would not fit.
        TrainingDivergedError: a loss is not finite; the last good checkpoint stays.
    """
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
        loop = _Run(algorithm, env_params, options, checkpoints, report, placed, splits or {})
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
        report: Callable[[str], None],
        placed: Any,
        splits: Splits,
    ) -> None:
        self._algorithm = algorithm
        self._config = algorithm.config
        self._params = env_params
        self._options = options
        self._checkpoints = checkpoints
        self._report = report
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
        steps, total = _steps(self._algorithm, state), self._config.num_iterations
        per_iteration, options = self._config.steps_per_iteration, self._options
        last_saved = steps
        first = jax.process_index() == 0
        writer: Any = NoWriter()
        failure: Exception | None = None
        if first:
            try:
                writer = MetricsWriter(
                    Path(options.output_dir),
                    {"algorithm": self._algorithm.name} | _settings(self._algorithm, options),
                    first_step=steps,
                    wandb_project=options.wandb_project,
                )
            except (ImportError, OSError) as error:
                failure = error
        if anywhere(failure is not None):
            raise failure or RuntimeError("process 0 cannot write metrics; it says why.")
        stopped = False
        try:
            if steps // per_iteration >= total:
                self._report(f"the run has had its {steps} steps")
            else:
                self._report("compiling")
            with (
                _interruptible(self._report) as interrupted,
                _bar(options.progress and first, total) as bar,
            ):
                bar.update(steps // per_iteration)
                began, began_steps = time.perf_counter(), steps
                for number in range(steps // per_iteration + 1, total + 1):
                    state, steps = self._one(state, number), number * per_iteration
                    bar.update(1)
                    end = number == total
                    stopped = anywhere(bool(interrupted)) and not end
                    evaluates = self._evaluates_after(number)
                    saves = end or stopped or evaluates or self._saves_after(steps, last_saved)
                    if number % options.log_every == 0 or evaluates or saves:
                        self._settle(steps)
                        seconds = time.perf_counter() - began
                        if options.log_training_metrics:
                            self._record["speed/steps_per_second"] = (steps - began_steps) / seconds
                            writer.write(steps, self._record)
                        bar.show(self._record)
                    if evaluates and not stopped:
                        writer.write(steps, self._evaluate(state))
                    if saves:
                        self._checkpoints.save(state, steps, self._score(evaluates and not stopped))
                        last_saved = steps
                    if number % options.log_every == 0 or evaluates or saves:
                        began, began_steps = time.perf_counter(), steps
                    if stopped:
                        # Whoever is asked to stop may soon be killed: first what is not to be lost.
                        self._checkpoints.wait()
                        self._report(f"stopped after {steps} steps; go on with --resume latest")
                        if evaluates:
                            writer.write(steps, self._evaluate(state))
                        break
                for networks, name in self._policies(state) if first else ():
                    save_policy(self._algorithm, networks, Path(options.output_dir) / name)
                if not stopped:
                    folder = Path(options.output_dir)
                    self._report(f"done after {steps} steps; checkpoints and policy in {folder}")
                return Outcome(state, self._record, self._results, stopped)
        finally:
            writer.close()

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

    def _settle(self, steps: int) -> None:
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
                saved = self._checkpoints.steps()
                kept = f"that of {saved[-1]} steps is good" if saved else "there is none"
                raise TrainingDivergedError(
                    f"not finite within the iterations before step {steps}{runs}: "
                    f"{', '.join(bad)}. Of the checkpoints {kept}. Begin anew in another "
                    "--output-dir; a lower learning_rate or max_grad_norm may help."
                )
        self._record = together(records)

    def _evaluates_after(self, number: int) -> bool:
        evals, total = self._options.num_evals, self._config.num_iterations
        return bool(evals) and number * evals // total > (number - 1) * evals // total

    def _saves_after(self, steps: int, last_saved: int) -> bool:
        every = self._options.checkpoint_every
        return bool(every) and steps // every > last_saved // every

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


@contextmanager
def _interruptible(report: Callable[[str], None]) -> Iterator[list[int]]:
    """A list that is filled when somebody asks the process to stop; asked twice, it stops."""
    asked: list[int] = []

    def ask(number: int, frame: Any) -> None:
        del frame
        if asked:
            raise KeyboardInterrupt
        asked.append(number)
        # Whoever reads the lines may have been stopped too, and a line may be under way.
        with suppress(OSError, RuntimeError):
            report("stopping within two iterations; asked again, at once, with no checkpoint")

    before = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        try:
            before[number] = signal.signal(number, ask)
        except ValueError:  # Only the main thread may.
            continue
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Bar:
    """tqdm's progress bar, or nothing."""

    def __init__(self, bar: Any) -> None:
        self._bar = bar

    def update(self, number: int) -> None:
        if self._bar is not None:
            self._bar.update(number)

    def show(self, record: dict[str, float]) -> None:
        if self._bar is not None and "episode/return" in record:
            self._bar.set_postfix(episode_return=f"{record['episode/return']:.1f}")


@contextmanager
def _bar(shown: bool, total: int) -> Iterator[_Bar]:
    if not shown:
        yield _Bar(None)
        return
    from tqdm import tqdm

    with tqdm(total=total, unit="iteration") as bar:
        yield _Bar(bar)
