"""Play a suite of levels with trained agents."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pixelbrax_gym.cli import UsageError, say
from pixelbrax_gym.cli._agents import MAY_DIFFER, AgentOptions, load, name_of
from pixelbrax_jax.validation import check_choice

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import numpy as np

    from pixelbrax_jax.agents.runner.trained import Trained
    from pixelbrax_jax.generalisation.making import LevelEnv, Levels


def check_suite(name: str) -> None:
    """Raise a UsageError that lists all suites if the name is unknown."""
    from pixelbrax_jax.generalisation.suites import SUITES

    try:
        check_choice("suite", name, SUITES)
    except ValueError as error:
        raise UsageError(str(error)) from error


def evaluate(
    options: AgentOptions,
    runs: Sequence[str],
    suite: str,
    episodes: int | None,
    output_dir: str | None,
    success_return: float | None,
) -> str:
    """Play the levels of a suite with all runs; return their table in Markdown."""
    if options.run_index:
        raise UsageError("--suite plays all runs of a folder; leave out --run.")
    agents = _load(options, runs)
    from pixelbrax_gym.generalisation.scores import RETURNS, ROWS, SHEET, play
    from pixelbrax_jax.agents.runner.evaluate import Evaluator
    from pixelbrax_jax.generalisation.making import make_levels

    report = partial(say, "evaluate")
    config = next(iter(agents.values())).algorithm.config.env
    levels = make_levels(config, suite, episodes, options.clips, report)
    _check_new_clips(agents, levels, report)
    report(f"{len(levels.levels)} levels in {levels.num_programs} programs")
    compiled: set[object] = set()

    def returns(agent: Trained, level: LevelEnv) -> np.ndarray:
        if level.env not in compiled:
            compiled.add(level.env)
            number = f"{len(compiled)} of {levels.num_programs}"
            report(f"{level.level.name}: compiling program {number}")
        own = Evaluator(agent.algorithm, level.env, level.params, num_episodes=levels.episodes)
        return own(agent.networks).returns

    players = {name: partial(returns, agent) for name, agent in agents.items()}
    try:
        scores = play(levels, players, output_dir, report, success_return)
    except KeyboardInterrupt:
        lost = "nothing is kept without --output-dir"
        kept = f"the same command goes on with the returns in {output_dir}"
        report(f"stopped; {kept if output_dir else lost}")
        raise
    if output_dir is not None:
        report(f"wrote {RETURNS}, {ROWS} and {SHEET} in {output_dir}")
    return scores.markdown()


def _load(options: AgentOptions, runs: Sequence[str]) -> Mapping[str, Trained]:
    """Load all runs by name; raise a ValueError unless they are seeds of one agent."""
    if options.pretrained is not None:
        return {options.pretrained: load(options, next(iter(runs), None))}
    if not runs:
        raise UsageError("--suite needs the folders of one or several runs, or --pretrained.")
    from pixelbrax_jax.agents.config import describe
    from pixelbrax_jax.agents.runner.trained import num_runs

    agents: dict[str, Trained] = {}
    given: set[Path] = set()
    for folder in runs:
        if (path := Path(folder).resolve()) in given:
            raise UsageError(f"run {folder} is given twice.")
        given.add(path)
        first = load(options, folder)
        for index in range(num_runs(folder)):
            agent = first if index == 0 else load(replace(options, run_index=index), folder)
            agents[name_of(agent, folder)] = agent
    (first_name, first), *others = agents.items()
    for name, agent in others:
        here, there = (
            {"algorithm": type(one.algorithm).__name__, **describe(one.algorithm.config)}
            for one in (first, agent)
        )
        for setting in [*here, *there]:
            if setting not in MAY_DIFFER and here.get(setting) != there.get(setting):
                raise ValueError(
                    f"runs of one call are seeds of one agent, but {setting} is "
                    f"{here.get(setting)!r} in {first_name} and {there.get(setting)!r} in {name}; "
                    "evaluate them in separate calls."
                )
    return agents


def _check_new_clips(
    agents: Mapping[str, Trained], levels: Levels, report: Callable[[str], object]
) -> None:
    """Raise a ValueError if a level of held-out clips shows clips of the training."""
    if levels.bank is None:
        return
    from pixelbrax_jax.agents.runner.settings import clip_digests
    from pixelbrax_jax.agents.runner.splits import plays_clips
    from pixelbrax_jax.agents.runner.trained import with_clips

    digests: list[str] = []
    for name, agent in agents.items():
        config = agent.algorithm.config
        if not plays_clips(config):
            continue
        _, shown = with_clips(agent, str(config.env.clips or "procedural"))
        if shown is None:
            report(f"{name} has no digest of its clips; assuming that no level shows them")
            continue
        digests = digests or clip_digests(levels.bank.to_device())
        for split, clips in levels.splits.items():
            shared = sum(digests[clip] in set(shown) for clip in clips)
            if shared and split != "train":
                raise ValueError(
                    f"{name} was trained with {shared} of the {len(clips)} clips of split "
                    f"{split!r} of {levels.bank.source}; choose other clips with --clips."
                )
