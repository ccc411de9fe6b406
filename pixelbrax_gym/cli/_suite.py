"""Play a suite of levels with trained agents."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pixelbrax_gym.cli import needs_extra, say
from pixelbrax_gym.cli.evaluate import Options, load

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pixelbrax_gym.generalisation.scores import Player
    from pixelbrax_jax.agents.runner.trained import Trained
    from pixelbrax_jax.generalisation.making import LevelEnv, Levels

_MAY_DIFFER = ("clips", "memory_budget_gb", "split")
"""Settings in which the seeds of one agent may differ."""


def run_suite(options: Options) -> int:
    """Play the levels of ``options.suite`` with all runs, and write their table."""
    assert options.suite is not None
    for name, value in (("split", options.split), ("in", options.where)):
        if value:
            raise ValueError(f"--suite plays its own levels; leave out --{name}.")
    if options.run_index:
        raise ValueError("--suite plays all runs of a folder; leave out --run.")
    agents = _load(options)
    with needs_extra("train"):
        from pixelbrax_gym.generalisation.evaluation import scores_of
        from pixelbrax_gym.generalisation.scores import SHEET, play
        from pixelbrax_jax.generalisation.frames import write_sheet
        from pixelbrax_jax.generalisation.making import make_levels
        from pixelbrax_jax.generalisation.suites import SUITES

    report = partial(say, "evaluate")
    config = next(iter(agents.values())).algorithm.config.env
    episodes = options.episodes
    if episodes is None:
        episodes = SUITES[options.suite].episodes
    levels = make_levels(config, options.suite, episodes, options.clips, report)
    _check_new_clips(agents, levels)
    report(f"{len(levels.levels)} levels in {levels.num_programs} programs")
    scores = scores_of(config, options.suite, levels)
    players = {name: _player(agent, episodes) for name, agent in agents.items()}
    play(levels, players, scores, options.output_dir, report)
    if options.output_dir is not None:
        path = Path(options.output_dir) / SHEET
        write_sheet(levels, path)
        report(f"wrote {path.parent}/returns.json, table.csv and {SHEET}")
    sys.stdout.write(scores.markdown() + "\n")
    return 0


def _load(options: Options) -> Mapping[str, Trained]:
    """Load all runs by name; raise a ValueError unless they are seeds of one agent."""
    if options.pretrained is not None:
        return {options.pretrained: load(options, next(iter(options.runs), None))}
    if not options.runs:
        raise ValueError("--suite needs the folders of one or several runs, or --pretrained.")
    from pixelbrax_jax.agents.config import describe
    from pixelbrax_jax.agents.runner.trained import num_runs

    agents: dict[str, Trained] = {}
    for folder in options.runs:
        first = load(options, folder)
        for index in range(num_runs(folder)):
            agent = first if index == 0 else load(_at(options, index), folder)
            name = f"{folder}, seed {agent.seed}, {agent.steps} steps"
            if name in agents:
                raise ValueError(f"run {folder} is given twice.")
            agents[name] = agent
    (first_name, first), *others = agents.items()
    for name, agent in others:
        here = {"algorithm": _name(first), **describe(first.algorithm.config)}
        there = {"algorithm": _name(agent), **describe(agent.algorithm.config)}
        for setting in [*here, *there]:
            if setting not in _MAY_DIFFER and here.get(setting) != there.get(setting):
                raise ValueError(
                    f"runs of one call are seeds of one agent, but {setting} is "
                    f"{here.get(setting)!r} in {first_name} and {there.get(setting)!r} in {name}; "
                    "evaluate them in separate calls."
                )
    return agents


def _at(options: Options, index: int) -> Options:
    from dataclasses import replace

    return replace(options, run_index=index)


def _name(agent: Trained) -> str:
    return type(agent.algorithm).__name__


def _player(agent: Trained, episodes: int) -> Player:
    from pixelbrax_jax.agents.runner.evaluate import Evaluator

    def play(level: LevelEnv) -> np.ndarray:
        evaluator = Evaluator(agent.algorithm, level.env, level.params, num_episodes=episodes)
        return evaluator(agent.networks).returns

    return play


def _check_new_clips(agents: Mapping[str, Trained], levels: Levels) -> None:
    """Raise a ValueError if a level of held-out clips shows clips of the training."""
    if levels.bank is None:
        return
    from pixelbrax_jax.agents.runner.settings import clip_digests
    from pixelbrax_jax.agents.runner.splits import plays_clips
    from pixelbrax_jax.agents.runner.trained import with_clips

    digests = None
    for name, agent in agents.items():
        if not plays_clips(agent.algorithm.config):
            continue
        shown = set(with_clips(agent, None)[1] or ())
        digests = digests or clip_digests(levels.bank.to_device())
        for split, clips in levels.splits.items():
            shared = sum(digests[clip] in shown for clip in clips)
            if shared and split != "train":
                raise ValueError(
                    f"{name} was trained with {shared} of the {len(clips)} clips of split "
                    f"{split!r} of {levels.bank.source}; choose other clips with --clips."
                )
