"""Draws docs/results.md's tables and plots from the runs that `tests.benchmarks.experiments` kept.

    python -m tests.benchmarks.results

What a random policy, and no action, earn in the same tasks is played once and kept beside them.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from pixelbrax_gym.bench.tables import table as markdown_table
from pixelbrax_jax import VectorPixelEnv, make
from pixelbrax_jax.agents.runner.evaluate import Evaluator, interquartile_mean, make_split
from pixelbrax_jax.agents.runner.trained import load_pretrained
from pixelbrax_jax.policy import read_pretrained
from tests.benchmarks.experiments import EPISODES, REVISION
from tests.benchmarks.pages import redraw

FOLDER = Path(__file__).parents[2] / "docs" / "results"
PAGE = FOLDER.with_suffix(".md")
MINUTES = (1, 3, 5, 15)
WINDOW = 60.0
"""Seconds whose training episodes make one point."""

TASK_SETTINGS = ("task", "backend", "reward_preset", "action_repeat", "episode_length")
"""Settings that decide what a return means."""


def task_name(settings: dict) -> str:
    """A task as the page calls it: with its reward where that is not Brax's."""
    reward = settings["reward_preset"]
    return settings["task"] + ("" if reward == "brax" else f", reward `{reward}`")


def untrained(settings: dict, episodes: int = 256) -> dict:
    """Returns of whole episodes under uniform actions in [-1, 1], and under none (0)."""
    env, params = make(obs_mode="state", **settings)
    envs = VectorPixelEnv(env, episodes, "disabled")
    steps = -(-settings["episode_length"] // env.action_repeat)

    @jax.jit
    def play(key, params, scale):
        def step(state, key):
            action = scale * jax.random.uniform(key, (episodes, env.action_size), minval=-1.0)
            state, timestep = envs.step(state, action, params)
            over = timestep.terminated | timestep.truncated
            return state, (timestep.info["episode_return"], over)

        first, rest = jax.random.split(key)
        state, _ = envs.reset(first, params)
        _, (returns, over) = jax.lax.scan(step, state, jax.random.split(rest, steps))
        return returns[over.argmax(0), np.arange(episodes)]

    result = {"settings": settings, "episodes": episodes}
    for name, scale in (("random", 1.0), ("none", 0.0)):
        returns = np.asarray(play(jax.random.key(0), params, scale))
        error = float(returns.std(ddof=1) / np.sqrt(episodes))
        result[name] = {"return": float(returns.mean()), "standard_error": error}
    return result


def baselines(runs: dict[str, dict]) -> dict[str, dict]:
    """What is earned without learning, by `task_name`; played where it is not known yet."""
    path = FOLDER / "untrained.json"
    known = json.loads(path.read_text()) if path.exists() else {}
    for run in runs.values():
        settings = {name: run["config"][name] for name in TASK_SETTINGS}
        name = task_name(settings)
        if known.get(name, {}).get("settings") != settings:
            known[name] = untrained(settings)
    path.write_text(json.dumps(known, indent=1) + "\n")
    return known


def by_brax_reward(task: str) -> dict:
    """What the pretrained policy of a task, trained by another reward, earns by Brax's."""
    path = FOLDER / "by_brax_reward.json"
    known = json.loads(path.read_text()) if path.exists() else {}
    command = read_pretrained(task)["command"]
    if known.get(task, {}).get("command") != command:
        agent = load_pretrained(task)
        config = replace(agent.algorithm.config, reward_preset="brax")
        play = Evaluator(agent.algorithm, *make_split(config, "clean"), num_episodes=EPISODES)
        result = play(agent.networks)
        found = {"return": result.mean, "standard_error": result.standard_error}
        known[task] = {"command": command, "episodes": EPISODES} | found
        path.write_text(json.dumps(known, indent=1) + "\n")
    return known[task]


def pair_of(run: dict) -> tuple[str, str]:
    """Algorithm and task."""
    return run["algorithm"], run["config"]["task"]


def clocked(runs: dict[str, dict]) -> dict[str, dict]:
    """The runs with the seconds that they take where nothing else computes; see `pace.py`.

    Those of which `pace.py` knows nothing keep their own.
    """
    presets = json.loads((FOLDER / "pace.json").read_text())["presets"]
    found = dict(runs)
    for name, run in runs.items():
        pace, config = presets.get("-".join(pair_of(run))), run["config"]
        if pace is None:
            continue
        first = config["num_envs"] * config["num_steps"] * config["action_repeat"]
        seconds = [
            pace["first_iteration"] + (steps - first) * pace["step"] for steps in run["steps"]
        ]
        found[name] = run | {"seconds": [round(x, 1) for x in seconds]}
    return found


def return_at(run: dict, when: float, clock: str = "seconds", window: float = WINDOW) -> float:
    """Mean return of the episodes that ended within a window before; NaN beyond the run.

    A run that ended in the last tenth of that time counts with its end.

    Args:
        run: what is kept of it.
        when: on that clock.
        clock: ``"seconds"`` or ``"steps"``.
        window: on that clock.
    """
    times = np.array(run[clock])
    if times[-1] < 0.9 * when:
        return float("nan")
    when = min(when, times[-1])
    # All episodes may end in one iteration: the latest of them then.
    last = times[times <= when].max(initial=times[0])
    chosen = (times > min(when - window, last - 1e-3)) & (times <= max(when, last))
    count = np.array(run["episodes"])[chosen]
    return float(np.average(np.array(run["return"])[chosen], weights=count))


def groups(runs: dict[str, dict]) -> dict[str, list[dict]]:
    """Runs that differ in their seeds alone, by their common name; the latest revision of each."""
    found: dict[str, list[dict]] = {}
    for name in sorted(runs):
        found.setdefault(re.sub(r"-\d+$", "", name), []).append(runs[name])
    for name, seeds in found.items():
        latest = max(run["revision"] for run in seeds)
        found[name] = [run for run in seeds if run["revision"] == latest]
    return found


def is_latest(runs: list[dict]) -> bool:
    """Whether runs of one name are of what the presets train today."""
    return runs[0]["revision"] == REVISION


def seeds_of(runs: list[dict]) -> str:
    """How many there are, with a star for those of an earlier revision."""
    return f"{len(runs)}{'' if is_latest(runs) else '*'}"


def middle(scores: list[float]) -> str:
    """An interquartile mean with its interval; of one score that alone."""
    scores = [score for score in scores if np.isfinite(score)]
    if len(scores) < 2:
        return f"{scores[0]:,.0f}" if scores else ""
    found = interquartile_mean(np.array(scores))
    return f"{found.value:,.0f} ({found.low:,.0f} to {found.high:,.0f})"


def final(run: dict, split: str = "clean") -> dict:
    """Return and standard error of the last evaluation."""
    last = run["evaluations"][-1]
    return {name: last[f"{split}/{name}"] for name in ("return", "standard_error")}


def distance(run: dict, other: dict) -> float:
    """Standard errors by which the last evaluation is above what is earned without learning."""
    reached = final(run)
    error = np.hypot(reached["standard_error"], other["standard_error"])
    return (reached["return"] - other["return"]) / error


def table(runs: dict[str, list[dict]], untrained: dict[str, dict]) -> str:
    """Return over time, clean, in Markdown."""
    lines = [
        "| task | agent | seeds | " + " | ".join(f"{m} min" for m in MINUTES) + " | mean action, "
        "at the end | above random | above no action |",
        "|" + "---|" * (6 + len(MINUTES)),
    ]
    for task, without in untrained.items():
        for name, text in (("random", "random policy"), ("none", "no action")):
            value, error = without[name]["return"], without[name]["standard_error"]
            blank = " | " * len(MINUTES)
            lines.append(f"| {task} | {text} | {blank} | {value:,.0f} ± {error:,.0f} | | |")
        for name, seeds in runs.items():
            config = seeds[0]["config"]
            if task_name(config) != task or config["distractors"]:
                continue
            times = " | ".join(middle([return_at(r, 60.0 * m) for r in seeds]) for m in MINUTES)
            ends = middle([final(run)["return"] for run in seeds])
            random, none = (
                f"{min(distance(run, without[name]) for run in seeds):.0f} s.e."
                for name in ("random", "none")
            )
            minutes = np.median([run["seconds"][-1] for run in seeds]) / 60.0
            agent = f"{seeds[0]['algorithm'].upper()}, {minutes:.0f} min"
            lines.append(
                f"| {task} | {agent} | {seeds_of(seeds)} | {times} | {ends} | {random} | {none} |"
            )
    return "\n".join(lines) + "\n"


def distracted_table(runs: dict[str, list[dict]]) -> str:
    """Mean actions with distractors: clean, in training's clips and in held-out ones."""
    lines = [
        "| task | distractors | agent | seeds | clean | training | held out | "
        "held out / training |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for _, seeds in sorted(runs.items(), key=lambda item: item[0].split("-")[1:]):
        config = seeds[0]["config"]
        if not config["distractors"]:
            continue
        splits = [[final(r, s)["return"] for r in seeds] for s in ("clean", "train", "test")]
        share = np.mean(splits[2]) / np.mean(splits[1])
        cells = " | ".join(middle(scores) for scores in splits)
        distractors = ", ".join(f"`{x}`" for x in config["distractors"])
        who = f"{task_name(config)} | {distractors} | {seeds[0]['algorithm'].upper()}"
        lines.append(f"| {who} | {seeds_of(seeds)} | {cells} | {share:.2f} |")
    return "\n".join(lines) + "\n" if len(lines) > 2 else "Not run yet.\n"


def centering_table() -> str:
    """What short runs reach with pixels as they come and around zero."""
    found = json.loads((FOLDER / "centering.json").read_text())["runs"]
    lines = []
    for plain, centered in zip(found[::2], found[1::2], strict=True):
        ends = []
        for run in (plain, centered):
            late = np.array(run["steps"]) > 0.8 * run["total_steps"]
            counts = np.array(run["episodes"])[late]
            ends.append(f"{np.average(np.array(run['return'])[late], weights=counts):,.0f}")
        video = ", `paper-video`" if run["options"] else ""
        steps = f"{run['total_steps']:,}"
        lines.append([f"{run['task']}{video}", run["algorithm"].upper(), steps, *ends])
    heads = ("task", "agent", "steps", "pixels in [0, 1]", "pixels around 0")
    return markdown_table(heads, lines) + "\n"


def plot(runs: dict[str, list[dict]], untrained: dict[str, dict], path: Path) -> None:
    """Return over steps: a thin line for each seed, a thick one and a band for their middle.

    Minutes depend on the machine, and runs are from several.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    shown = {name: seeds for name, seeds in runs.items() if name.count("-") == 1}
    tasks = list(dict.fromkeys(pair_of(seeds[0])[1] for seeds in shown.values()))
    figure, panels = plt.subplots(
        1, len(tasks), figsize=(4 * len(tasks), 3.4), layout="constrained", squeeze=False
    )
    colors = {"ppo": "C0", "ppg": "C1", "dcpg": "C2"}
    for task, axes in zip(tasks, panels[0], strict=True):
        title = next(task_name(r[0]["config"]) for r in shown.values() if pair_of(r[0])[1] == task)
        for name in (f"{algorithm}-{task}" for algorithm in colors):
            if name not in shown:
                continue
            color, seeds = colors[name.split("-")[0]], shown[name]
            end = min(r["steps"][-1] for r in seeds)
            grid, window = np.linspace(0.05 * end, end, 40), 0.1 * end
            lines = np.array([[return_at(run, t, "steps", window) for t in grid] for run in seeds])
            for line in lines:
                axes.plot(grid / 1e6, line, color=color, alpha=0.3, linewidth=0.7)
            label = name.split("-")[0].upper() + ("" if is_latest(seeds) else "*")
            if len(seeds) > 1:
                found = [interquartile_mean(column) for column in lines.T]
                low, high = [f.low for f in found], [f.high for f in found]
                axes.fill_between(grid / 1e6, low, high, color=color, alpha=0.2, linewidth=0)
                lines = np.array([[f.value for f in found]])
            axes.plot(grid / 1e6, lines[0], color=color, linewidth=1.8, label=label)
        for kind, style in (("random", ":"), ("none", "--")):
            label = {"random": "random policy", "none": "no action"}[kind]
            axes.axhline(
                untrained[title][kind]["return"], color="gray", linestyle=style, label=label
            )
        axes.set(xlabel="million control steps", title=title)
        axes.grid(alpha=0.3)
    panels[0][0].set_ylabel("return of training episodes")
    for axes in panels[0]:
        axes.legend(fontsize=7)
    figure.savefig(path, dpi=130)


def tables(runs: dict[str, list[dict]], untrained: dict[str, dict]) -> dict[str, str]:
    """All of the page's tables, by name."""
    return {
        "clean": table(runs, untrained),
        "distracted": distracted_table(runs),
        "centering": centering_table(),
    }


def kept_runs() -> dict[str, dict]:
    """All that is kept, by name, with the seconds of undisturbed runs."""
    files = (FOLDER / "runs").glob("*.json")
    return clocked({path.stem: json.loads(path.read_text()) for path in files})


def main() -> None:
    """Draw everything."""
    runs = kept_runs()
    if not runs:
        raise SystemExit("no run is kept yet: python -m tests.benchmarks.experiments makes them")
    without, grouped = baselines(runs), groups(runs)
    by_brax_reward("walker2d")
    redraw(PAGE, tables(grouped, without))
    plot(grouped, without, FOLDER / "clean.png")


if __name__ == "__main__":
    main()
