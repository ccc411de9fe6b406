"""Measure the returns of a trained agent."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from pixelbrax_gym.cli import CommandError, UsageError, parse, say
from pixelbrax_gym.cli._agents import AgentOptions, load
from pixelbrax_gym.cli._suite import check_suite, evaluate
from pixelbrax_jax.tasks import SUITES
from pixelbrax_jax.validation import check_positive_int

if TYPE_CHECKING:
    from pixelbrax_jax.agents.runner.trained import Trained


@dataclass(frozen=True)
class Options(AgentOptions):
    """Plays whole episodes with a checkpoint and writes a line of JSON for each split.

    Actions are the policy's means. Every call plays the same episodes. With --suite it plays the
    levels of a suite with all runs, which are the seeds of one agent, and writes their table.
    """

    runs: Annotated[Positional[tuple[str, ...]], arg(metavar="RUN")] = ()
    """Output folder of the training run; with --suite one or several."""
    episodes: int | None = None
    """Number of episodes of each split or level; default: 32, or the suite's number."""
    suite: Annotated[str | None, arg(metavar="NAME")] = None
    """Plays the levels of a suite instead of splits, and writes a table in Markdown: dmcgb, dmcgb2,
    dcs, paper, subtle or axes."""
    output_dir: str | None = None
    """Folder for the suite's returns.json, table.csv and levels.png. Levels whose returns it has
    are not played again."""
    success_return: float | None = None
    """With --suite an episode with at least this return is a success; default: the task's."""
    split: tuple[Literal["clean", "train", "test"], ...] = ()
    """Splits to evaluate; default: clean, with distractors also train, and test if it has clips
    that training does not show."""
    where: Annotated[
        Literal["dm_control", "dm_control_physics", "dm_control_picture"] | None, arg(name="in")
    ] = None
    """Plays split clean also in dm_control, from the same initial states, and compares the returns:
    dm_control (its physics and its OpenGL picture), dm_control_physics (with our picture) or
    dm_control_picture (with our physics). Needs a task of the DM Control Suite."""


def run(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse("evaluate", Options, arguments)
    if options.suite is not None:
        check_suite(options.suite)
        for name, value in (("split", options.split), ("in", options.where)):
            if value:
                raise UsageError(f"--suite plays its own levels; leave out --{name}.")
        threshold = options.success_return
        if threshold is not None and not math.isfinite(threshold):
            raise UsageError(f"--success-return must be a finite number, got {threshold}.")
        own = options.episodes, options.output_dir, threshold
        sys.stdout.write(evaluate(options, options.runs, options.suite, *own) + "\n")
        return 0
    for name, given in (
        ("output-dir", options.output_dir),
        ("success-return", options.success_return),
    ):
        if given is not None:
            raise UsageError(f"--{name} needs --suite.")
    if len(options.runs) > 1:
        raise UsageError(f"give one run, or --suite for several; got {', '.join(options.runs)}.")
    agent = load(options, next(iter(options.runs), None))
    from pixelbrax_jax.agents.runner.evaluate import Evaluator
    from pixelbrax_jax.agents.runner.settings import place_of
    from pixelbrax_jax.agents.runner.splits import make_splits
    from pixelbrax_jax.agents.runner.trained import with_clips

    report = partial(say, "evaluate")
    episodes = 32 if options.episodes is None else options.episodes
    check_positive_int("episodes", episodes)
    if options.where is not None:
        _write(_compare(agent, options, episodes, report))
        return 0
    config, shown = with_clips(agent, options.clips)
    if options.clips and not shown:
        clips = options.clips
        report(f"the run has no digest of its clips; assuming that {clips} has the same clips")
    for name, (env, params) in make_splits(config, options.split, shown=shown, report=report):
        report(f"split {name}: playing {episodes} episodes, after up to a minute of compilation")
        result = Evaluator(agent.algorithm, env, params, num_episodes=episodes)(agent.networks)
        row = {"steps": agent.steps, "seed": agent.seed, "split": name, "episodes": episodes}
        if params.clips is not None:
            row["clips"] = place_of(str(config.env.clips or "procedural"))
        _write(row | result.scalars)
    return 0


def _compare(
    agent: Trained, options: Options, episodes: int, report: Callable[[str], None]
) -> dict[str, Any]:
    """Play the same episodes here and in dm_control; return the row."""
    from pixelbrax_jax.agents.runner.evaluate import Evaluator, paired
    from pixelbrax_jax.agents.runner.splits import make_split
    from pixelbrax_jax.agents.runner.transfer import play_in

    config, where = agent.algorithm.config, options.where
    env = config.env
    if env.task not in (tasks := SUITES["dmc"].tasks):
        raise ValueError(
            f"--in {where} needs a task of the DM Control Suite, but the task of the run is "
            f"{env.task!r}; allowed: {', '.join(tasks)}."
        )
    if env.obs_mode != "pixels" or env.num_cameras > 1:
        raise ValueError(
            f"--in {where} shows pixels of one camera, but the run has obs_mode={env.obs_mode!r} "
            f"and camera={env.camera!r}: evaluate it without --in."
        )
    if options.clips is not None or set(options.split) - {"clean"}:
        raise ValueError(
            f"--in {where} plays split clean alone, because dm_control has no distractors: leave "
            "out --clips and --split."
        )
    from pixelbrax_jax.physics.dmc.suite import SuiteEnv

    physics, picture = where != "dm_control_picture", where != "dm_control_physics"
    for name, value in (("distractors", env.distractors), ("dynamics", env.dynamics)):
        if value:
            report(f"{name}={value!r} of the run are left out, here and in dm_control")
    if picture and (env.look not in ("default", "dmc") or env.shadows is not None):
        report(f"dm_control shows its own look, not look={env.look!r}, shadows={env.shadows}")
    try:
        simulator = SuiteEnv(
            env.task,
            camera=str(env.camera) if picture else "default",
            size=(env.height, env.width) if picture else None,
            samples=env.samples,
        )
    except (ImportError, ValueError) as error:
        fix = " --in dm_control_physics takes our picture instead." if picture else ""
        raise CommandError(f"--in {where}: {error}{fix}") from error
    with closing(simulator):
        clean, params = make_split(config, "clean")
        player, networks = agent.algorithm, agent.networks
        report(f"playing {episodes} episodes here, after up to a minute of compilation")
        here = Evaluator(player, clean, params, num_episodes=episodes)(networks)
        report(f"here: return {here.mean:.1f}")
        there = play_in(
            simulator,
            player,
            networks,
            clean,
            params,
            num_episodes=episodes,
            physics=physics,
            picture=picture,
            report=lambda line: report(f"{where}: {line}"),
        )
    row = {"task": env.task, "in": where, "steps": agent.steps, "seed": agent.seed}
    row |= {"split": "clean", "episodes": episodes}
    return row | here.scalars | paired(here, there)


def _write(row: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(row) + "\n")
    sys.stdout.flush()
