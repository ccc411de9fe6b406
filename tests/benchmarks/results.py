"""Tables, figures and plots of what agents learn, from the runs that `experiments.py` kept."""

from __future__ import annotations

import json
import math
import re
from functools import cache, partial

import numpy as np

from pixelbrax_gym.bench.tables import table as markdown_table
from pixelbrax_jax import list_pretrained
from pixelbrax_jax.agents.presets import preset
from pixelbrax_jax.policy import read_pretrained
from pixelbrax_jax.tasks import DMC_TASKS, GYM_TASKS
from tests.benchmarks.experiments import DOCS, TASKS
from tests.benchmarks.pages import Figures
from tests.benchmarks.performance import rounded, span

FOLDER = DOCS / "results"
MINUTES = (1, 3, 5, 15)
WINDOW = 60.0
"""Seconds whose training episodes make one point."""


def read(name: str) -> dict:
    """A JSON file beside the runs."""
    return json.loads((FOLDER / name).read_text("utf-8"))


def task_key(config: dict) -> str:
    """A task and its rewards, as files name them."""
    return f"{config['task']}-{config['reward_preset']}"


def clocked(runs: dict[str, dict]) -> dict[str, dict]:
    """The runs with the seconds that they take where nothing else computes; see `pace.py`.

    Those under distractors, which `pace.py` does not measure, keep their own.
    """
    presets = read("pace.json")["presets"]
    found = dict(runs)
    for name, run in runs.items():
        if run["config"]["distractors"]:
            continue
        pace = presets[f"{run['algorithm']}-{run['config']['task']}"]
        seconds = [
            pace["first_seconds"] + (steps - pace["first_steps"]) * pace["step"]
            for steps in run["steps"]
        ]
        found[name] = run | {"seconds": [round(x, 1) for x in seconds]}
    return found


def return_at(run: dict, when: float, clock: str = "seconds", window: float = WINDOW) -> float:
    """Mean return of the episodes that ended within a window before, by seconds or steps."""
    times = np.array(run[clock])
    if times[-1] < when:
        return float("nan")
    # All episodes may end in one iteration: the latest of them then.
    last = times[times <= when].max(initial=times[0])
    chosen = (times > min(when - window, last - 1e-3)) & (times <= max(when, last))
    count = np.array(run["episodes"])[chosen]
    return float(np.average(np.array(run["return"])[chosen], weights=count))


def groups(runs: dict[str, dict]) -> dict[str, list[dict]]:
    """Runs that differ in their seeds alone, by their common name."""
    found: dict[str, list[dict]] = {}
    for name in sorted(runs):
        found.setdefault(re.sub(r"-\d+$", "", name), []).append(runs[name])
    return found


def by_task(runs: dict[str, list[dict]]) -> dict[str, dict[str, list[dict]]]:
    """Groups without distractors by `task_key`; the presets' own rewards before others."""
    clean = {name: seeds for name, seeds in runs.items() if not seeds[0]["config"]["distractors"]}
    found: dict[str, dict[str, list[dict]]] = {}
    for name in sorted(clean, key=lambda name: (TASKS.index(name.split("-")[1]), "brax" in name)):
        found.setdefault(task_key(clean[name][0]["config"]), {})[name] = clean[name]
    return found


def title(key: str, keys: list[str]) -> str:
    """A task as the page calls it: with its reward preset where another one is there, too."""
    task, reward = key.rsplit("-", 1)
    alone = sum(other.rsplit("-", 1)[0] == task for other in keys) == 1
    return task if alone else f"{task} ({reward})"


def middle(scores: list[float]) -> str:
    """A mean over seeds with the lowest and the highest, in one line; of one score that alone."""
    mean = f"{np.mean(scores):,.0f}"
    if len(scores) == 1:
        return mean
    return f"{mean} ({min(scores):,.0f} to {max(scores):,.0f})"


def final(run: dict, split: str = "clean") -> dict:
    """Return, standard error and length of an episode of the last evaluation."""
    last = run["evaluations"][-1]
    return {name: last[f"{split}/{name}"] for name in ("return", "standard_error", "length")}


def reached(seeds: list[dict]) -> str:
    """The last evaluation: of one seed with its standard error."""
    ends = [final(run) for run in seeds]
    if len(ends) > 1:
        return middle([end["return"] for end in ends])
    return f"{ends[0]['return']:,.0f} ± {ends[0]['standard_error']:,.0f}"


def distance(run: dict, other: dict) -> float:
    """Standard errors by which the last evaluation is above what is earned without learning."""
    end = final(run)
    error = np.hypot(end["standard_error"], other["standard_error"])
    return (end["return"] - other["return"]) / error


def agent(run: dict) -> str:
    """An algorithm as the page calls it: with its learning rate where that is not the preset's."""
    name, config = run["algorithm"], run["config"]
    rate = config["learning_rate"]
    usual = preset(name, "cpu", config["task"]).learning_rate
    return name.upper() + ("" if rate == usual else f", learning rate {rate:g}")


def clean_table(runs: dict[str, list[dict]]) -> str:
    """Return over time, without distractors, in Markdown."""
    heads = ["task", "agent", "seeds", "million steps", "minutes", *(f"{m} min" for m in MINUTES)]
    heads += ["mean action", "length", "s.e. above random"]
    lines, tasks, without = [], by_task(runs), read("untrained.json")
    for key, of_task in tasks.items():
        for seeds in of_task.values():
            minutes = seeds[0]["seconds"][-1] / 60.0
            at_minutes = [np.mean([return_at(run, 60.0 * m) for run in seeds]) for m in MINUTES]
            lines.append(
                [
                    title(key, list(tasks)),
                    agent(seeds[0]),
                    len(seeds),
                    f"{seeds[0]['config']['total_steps'] / 1e6:.1f}",
                    f"{minutes:.0f}",
                    *("" if np.isnan(value) else f"{value:,.0f}" for value in at_minutes),
                    reached(seeds),
                    f"{np.mean([final(run)['length'] for run in seeds]):.0f}",
                    f"{min(distance(run, without[key]['random']) for run in seeds):.0f}",
                ]
            )
    return markdown_table(heads, lines)


def short_table(runs: dict[str, list[dict]]) -> str:
    """What the preset's own runs reach, and what is earned without learning, in Markdown."""
    algorithms = ("ppo", "ppg", "dcpg")
    heads = ("task", *(name.upper() for name in algorithms), "random policy", "no action")
    lines, tasks, without = [], by_task(runs), read("untrained.json")
    for key, of_task in tasks.items():
        task = key.rsplit("-", 1)[0]
        own = [of_task[name] for x in algorithms if (name := f"{x}-{task}") in of_task]
        if len(own) == len(algorithms):
            ends = [without[key][kind] for kind in ("random", "none")]
            earned = [_with_error(end) for end in ends]
            lines.append([title(key, list(tasks)), *map(reached, own), *earned])
    return markdown_table(heads, lines)


def baselines_table(runs: dict[str, list[dict]]) -> str:
    """What is earned without learning, and by another agent from the state, in Markdown."""
    heads = ("task", "random policy", "no action", "Brax's PPO, from the state", "million steps")
    lines, tasks = [], by_task(runs)
    without, from_state = read("untrained.json"), read("from_state.json")
    for key in tasks:
        ends = [without[key][kind] for kind in ("random", "none")]
        line = [_with_error(end) for end in ends]
        if seen := from_state.get(key):
            line += [f"{seen['return'][-1]:,.0f}", f"{seen['steps'][-1] / 1e6:.1f}"]
        lines.append([title(key, list(tasks)), *line, *[""] * (4 - len(line))])
    return markdown_table(heads, lines)


def held_out_ratio(seeds: list[dict]) -> float:
    """Mean return under held-out clips over that under the clips of training."""
    test, train = ([final(run, split)["return"] for run in seeds] for split in ("test", "train"))
    return float(np.mean(test) / np.mean(train))


def distracted_table(runs: dict[str, list[dict]]) -> str:
    """Mean actions of agents that were trained under distractors, in Markdown.

    Without clips training and test are the same.
    """
    heads = ["task", "trained under", "agent", "seeds", "evaluated without", "under training's"]
    heads += ["under held-out clips", "held out / training", "trained and evaluated without"]
    lines, keys = [], list(by_task(runs))
    for name in sorted(runs, key=lambda name: name.split("-")[1:]):
        seeds = runs[name]
        algorithm, config = seeds[0]["algorithm"], seeds[0]["config"]
        if not config["distractors"]:
            continue
        given = {run["config"]["seed"] for run in seeds}
        plain = runs.get(f"{algorithm}-{config['task']}", [])
        plain = [final(run)["return"] for run in plain if run["config"]["seed"] in given]
        clean, train, test = (
            [final(run, split)["return"] for run in seeds] for split in ("clean", "train", "test")
        )
        held_out = [middle(test), f"{held_out_ratio(seeds):.2f}"]
        lines.append(
            [
                title(task_key(config), keys),
                ", ".join(f"`{distractor}`" for distractor in config["distractors"]),
                algorithm.upper(),
                len(seeds),
                middle(clean),
                middle(train),
                *(held_out if config["clips"] else ["", ""]),
                f"{np.mean(plain):,.0f}" if plain else "",
            ]
        )
    return markdown_table(heads, lines)


def pretrained_table() -> str:
    """The policies that come with the package, in Markdown."""
    heads = (
        "task",
        "reward preset",
        "agent",
        "million steps",
        "return of 32 episodes",
        "PixelBrax",
    )
    lines = []
    for name in sorted(list_pretrained(), key=(*TASKS, *DMC_TASKS, *GYM_TASKS).index):
        about = read_pretrained(name)
        lines.append(
            [
                f"`{name}`",
                "" if name not in TASKS else f"`{about['env_options']['reward_preset']}`",
                "DrQ-v2" if about["algorithm"] == "drqv2" else about["algorithm"].upper(),
                f"{about['steps'] / 1e6:.1f}",
                _with_error(about),
                about["versions"]["pixelbrax"],
            ]
        )
    return markdown_table(heads, lines)


@cache
def kept_runs() -> dict[str, dict]:
    """All that is kept from CPUs, by name, with the seconds of undisturbed runs."""
    files = (path for path in (FOLDER / "runs").glob("*.json") if "-gpu-" not in path.stem)
    return clocked({path.stem: json.loads(path.read_text("utf-8")) for path in files})


@cache
def seeds_of() -> dict[str, list[dict]]:
    """The runs by name; those of one name differ in their seeds alone."""
    return groups(kept_runs())


def mean_end(name: str, digits: int = 2) -> str:
    """Mean return at the end of the runs of that name."""
    return rounded(np.mean([final(run)["return"] for run in seeds_of()[name]]), digits)


def mean_length(name: str) -> str:
    """Control steps of an episode at the end."""
    return f"{np.mean([final(run)['length'] for run in seeds_of()[name]]):.0f}"


def least_distance(kind: str) -> str:
    """Standard errors by which every run without distractors is above ``random`` or ``none``."""
    untrained = read("untrained.json")
    least = min(
        distance(run, untrained[task][kind])
        for task, of_task in by_task(seeds_of()).items()
        for seeds in of_task.values()
        for run in seeds
    )
    return f"{math.floor(least)}"


def with_clips() -> list[list[dict]]:
    """Runs under videos, by algorithm and task."""
    return [seeds for seeds in seeds_of().values() if seeds[0]["config"]["clips"]]


def error_of_ratio(run: dict) -> float:
    """Standard error of a run's return under held-out clips over that under those of training."""
    ends = final(run, "test"), final(run, "train")
    relative = (end["standard_error"] / end["return"] for end in ends)
    return held_out_ratio([run]) * math.hypot(*relative)


def elsewhere(name: str) -> str:
    """What a pretrained policy earns where it was not trained."""
    return f"{read('elsewhere.json')[name]['return']:,.0f}"


def swingup_table() -> str:
    """DrQ-v2 as published, beside its published curve."""
    kept = read("drqv2_swingup.json")
    ours = {each["steps"]: each for each in kept["evaluations"]}
    published = {int(steps): returns for steps, returns in kept["published"]["returns"].items()}
    lines = [
        [
            f"{steps:,}",
            _with_error(ours[steps]) if steps in ours else "",
            _with_range(published[steps]) if steps in published else "",
        ]
        for steps in sorted({*ours, *published})
    ]
    return markdown_table(("frames", "one seed here", "ten seeds, published"), lines)


def _with_error(found: dict) -> str:
    return f"{found['return']:,.0f} ± {found['standard_error']:,.0f}"


def _with_range(returns: list[float]) -> str:
    return f"{np.mean(returns):.0f} ({span(returns, '{:.0f}')})"


FIGURES: Figures = {
    "short": lambda: short_table(seeds_of()),
    "pretrained": pretrained_table,
    **{task: partial(mean_end, f"ppo-{task}") for task in TASKS},
    **{f"{task}-length": partial(mean_length, f"ppo-{task}") for task in ("walker2d", "humanoid")},
    "humanoid-long": partial(mean_end, "ppo-humanoid-long", 3),
    "halfcheetah-long": partial(mean_end, "ppo-halfcheetah-long"),
    "halfcheetah-longest": partial(mean_end, "ppo-halfcheetah-longest-slow"),
    "above-random": partial(least_distance, "random"),
    "above-none": partial(least_distance, "none"),
    "held-out": lambda: span(map(held_out_ratio, with_clips())),
    "held-out-errors": lambda: span(error_of_ratio(run) for seeds in with_clips() for run in seeds),
    "under-video": partial(elsewhere, "halfcheetah under paper-video"),
    "under-color": partial(elsewhere, "halfcheetah under paper-color"),
}
RUNS: Figures = {
    "clean": lambda: clean_table(seeds_of()),
    "baselines": lambda: baselines_table(seeds_of()),
    "distracted": lambda: distracted_table(seeds_of()),
}
DRQV2: Figures = {"swingup": swingup_table}
TRIED: Figures = {"by-brax": partial(elsewhere, "walker2d by Brax's reward")}


def plot() -> None:
    """Draw the learning curves; what is earned without learning is played once and kept."""
    # Drawing and playing need more than tables do.
    from tests.benchmarks import plots
    from tests.benchmarks.baselines import play_baselines

    tasks = by_task(seeds_of())
    play_baselines({key: next(iter(g.values()))[0]["config"] for key, g in tasks.items()})
    panels = {}
    for key, of_task in tasks.items():
        # Runs of the presets' own length and rewards.
        shown = [seeds for name, seeds in of_task.items() if name.count("-") == 1]
        if shown:
            panels[title(key, list(tasks))] = (shown, read("untrained.json")[key])
    plots.learning(panels, FOLDER / "clean.png")
