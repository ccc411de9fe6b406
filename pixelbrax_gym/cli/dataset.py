"""Record episodes clean and under a level of a suite, as a dataset."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, UseAppendAction, arg

from pixelbrax_gym.cli import UsageError, parse, say
from pixelbrax_gym.cli._agents import AgentOptions, load, name_of
from pixelbrax_gym.cli._suite import check_suite
from pixelbrax_jax.validation import check_choice

if TYPE_CHECKING:
    from pixelbrax_jax.agents.runner.trained import Trained


@dataclass(frozen=True, kw_only=True)
class Options(AgentOptions):
    """Records the same episodes clean and under a level, with states, actions and rewards.

    Actions are an agent's, or random. The dataset is Minari's, lossless; a stopped call continues.
    """

    suite: Annotated[str, arg(metavar="NAME")]
    """Suite that has the level: dmcgb, dmcgb2, dcs, paper, subtle or axes."""
    level: Annotated[str, arg(metavar="NAME")]
    """Name of the level, such as video-hard."""
    output_dir: str
    """Folder of the dataset."""
    folder: Annotated[Positional[str | None], arg(metavar="FOLDER")] = None
    """Output folder of a training run, whose agent plays."""
    task: str | None = None
    """Task of random actions, instead of an agent."""
    episodes: int | None = None
    """Number of episodes; default: the suite's."""
    images: Annotated[tuple[str, ...], UseAppendAction] = ()
    """Further image of the clean episode, depth or segmentation; may be repeated."""
    sees: str = "clean"
    """Images that the agent sees: clean or level."""
    num_envs: int = 8
    """Number of episodes that are played, and held in memory, together."""
    height: int | None = None
    """Height of the images in pixels, only with --task; default: 84."""
    width: int | None = None
    """Width of the images in pixels, only with --task; default: 84."""
    clips: str | None = None
    """Folder of the videos, or procedural, for levels that show any."""


def run(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse("dataset", Options, arguments)
    check_suite(options.suite)
    from pixelbrax_gym.generalisation.pairs import record_pairs

    size = {name: getattr(options, name) for name in ("height", "width")}
    size = {name: number for name, number in size.items() if number is not None}
    agent = [options.folder, options.pretrained, options.steps, options.best, options.run_index]
    if options.task is not None:
        if any(agent):
            raise UsageError("--task is for random actions; leave out the agent and its options.")
        policy, name, env = None, "uniform", {"task": options.task, **size}
    elif not any(agent[:2]):
        raise UsageError(
            "who acts? Give the folder of a run, --pretrained with a name, or --task for random "
            "actions."
        )
    elif size:
        raise UsageError(f"--{next(iter(size))} is only for --task; an agent has its own size.")
    else:
        policy, name, env = _played(load(options, options.folder), options)
    path = record_pairs(
        policy,
        env.pop("task"),
        options.suite,
        options.level,
        options.output_dir,
        episodes=options.episodes,
        clips=options.clips,
        images=options.images,
        sees=options.sees,
        policy_name=name,
        num_envs=options.num_envs,
        output="jax",
        report=partial(say, "dataset"),
        **env,
    )
    sys.stdout.write(f"{path}\n")
    return 0


def _played(agent: Trained, options: Options) -> tuple[Any, str, dict[str, Any]]:
    """Return the agent's policy, its name and the options of its environment."""
    import jax

    from pixelbrax_gym.generalisation.scores import LEFT_OUT
    from pixelbrax_jax.config import ENV_OPTIONS

    config, algorithm = agent.algorithm.config.env, agent.algorithm
    check_choice("obs_mode of the agent", config.obs_mode, ("pixels",))
    networks = {name: agent.networks[name] for name in algorithm.acting}
    name = options.pretrained or name_of(agent, str(options.folder))
    left_out = {*LEFT_OUT, "obs_mode"} - {"task"}
    env = {name: getattr(config, name) for name in ENV_OPTIONS if name not in left_out}
    return jax.jit(partial(algorithm.act, networks)), name, env
