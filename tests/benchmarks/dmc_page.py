"""Tables and figures about the DM Control Suite, from docs/dmc and docs/leaderboard."""

from __future__ import annotations

import json
from contextlib import suppress
from functools import cache, partial
from itertools import groupby
from math import sqrt
from operator import itemgetter
from pathlib import Path
from statistics import mean, median, stdev

from pixelbrax_gym.bench.tables import number, table
from pixelbrax_gym.cli import _leaderboard as leaderboard
from pixelbrax_jax.tasks import DMC_TASKS
from tests.benchmarks import tables
from tests.benchmarks.tables import find

FOLDER = Path(__file__).parents[2] / "docs" / "dmc"


def rows(group: str = "dmc") -> list[dict]:
    """Outcomes beside dm_control, of the machine that was measured last."""
    files = sorted(FOLDER.glob("cpu-*.json"))
    kept = [json.loads(file.read_text("utf-8")) for file in files]
    cases = max(
        (k["cases"] for k in kept), key=lambda found: max(c["date"] for c in found.values())
    )
    return [row for row in cases.values() if row["group"] == group]


def speed() -> str:
    """Each task beside dm_control, in Markdown."""
    return tables.dmc(rows())


def looks() -> str:
    """Some tasks with the whole picture beside dm_control, in Markdown."""
    return tables.looks(rows("dmc-look"))


def tasks() -> str:
    """All tasks by domain, in Markdown."""
    lines = []
    for domain, rows in groupby(DMC_TASKS.values(), key=lambda row: row.domain):
        page = f"tasks/dmc.md#{domain.replace('_', '-')}"
        names = ", ".join(f"`{row.name}`" for row in rows)
        lines.append([f"[{domain.replace('_', ' ')}]({page})", names])
    return table(("domain", "names"), lines)


@cache
def kept_physics() -> dict[str, dict]:
    """How far each task is from dm_control's."""
    kept: dict[str, dict] = json.loads((FOLDER / "physics.json").read_text("utf-8"))["tasks"]
    return kept


def same_state() -> str:
    """The largest difference in the same state."""
    tasks = kept_physics().values()
    parts = ("reward", "observation")
    return f"{max(task['same_state'][part] for task in tasks for part in parts):.0e}"


def states() -> str:
    """How many states were stepped; none of their velocities is off."""
    tasks = kept_physics().values()
    assert not any(task["control_step"]["velocities_off"] for task in tasks)
    return f"{sum(task['states'] for task in tasks):,}"


def whole(measure: str, **of: str) -> str:
    """The span over tasks of the whole picture's speed over that of another measure."""
    found = rows("dmc-look")
    tasks = dict.fromkeys(row["arguments"]["task"] for row in found)
    ours = [speed_of(found, "dmc.with_look", task=task, look="dmc") for task in tasks]
    others = [speed_of(found, measure, task=task, **of) for task in tasks]
    shares = sorted(one / other for one, other in zip(ours, others, strict=True))
    ends = shares[0], shares[-1]
    return " to ".join(f"{share:.0f}" if share > 1 else f"{share:.2f}" for share in ends)


def speed_of(found: list[dict], measure: str, **arguments: str) -> float:
    """Steps a second of a case that was measured."""
    return float(tables.value(find(found, measure, **arguments), "steps_per_second"))


def part() -> str:
    """After how many control steps the first episode parts."""
    return f"{min(n for task in kept_physics().values() if (n := task['episode']['apart']))}"


def first_frames(which: str) -> str:
    """Seconds to the first frame, over all tasks."""
    ours = [row for row in rows() if row["measure"] == "dmc.pixels" and row["status"] == "ok"]
    seconds = [row["values"]["first_frame"][which] for row in ours]
    return f"{min(seconds):.0f} to {max(seconds):.0f}"


def physics() -> str:
    """How far each domain is from dm_control's, the worst of its tasks, in Markdown."""
    kept = kept_physics()
    domains: dict[str, list[dict]] = {}
    for name, row in DMC_TASKS.items():
        domains.setdefault(row.domain, []).append(kept[name])
    lines = []
    for domain, tasks in domains.items():
        errors = [
            max(task[part][name] for task in tasks)
            for part, name in (
                ("same_state", "reward"),
                ("same_state", "observation"),
                ("control_step", "reward"),
                ("control_step", "velocity_median"),
            )
        ]
        off = sum(task["control_step"]["velocities_off"] for task in tasks)
        states = sum(task["states"] for task in tasks)
        p = min(task["initial_states"]["lowest_p"] for task in tasks)
        apart = min((n for task in tasks if (n := task["episode"]["apart"])), default="never")
        shown = [f"{error:.0e}" for error in errors]
        lines.append([domain, len(tasks), *shown, f"{off} of {states}", apart, f"{p:.2g}"])
    heads = (
        "domain",
        "tasks",
        "reward",
        "observation",
        "reward, a step on",
        "velocity, a step on: median",
        "beyond 0.01",
        "episodes part after",
        "lowest p",
    )
    return table(heads, lines)


def speeds(task: str) -> tuple[float, float]:
    """Steps per second of a task, ours and dm_control's."""
    found = rows()
    ours = speed_of(found, "dmc.pixels", task=task)
    return ours, speed_of(found, "peers.dm_control_envs", task=task)


@cache
def ratios() -> dict[str, float]:
    """How many times as fast as dm_control, by task, the slowest first."""
    found = {}
    for task in dict.fromkeys(row["arguments"]["task"] for row in rows()):
        with suppress(KeyError, TypeError):  # one side was not timed
            ours, theirs = speeds(task)
            found[task] = ours / theirs
    return dict(sorted(found.items(), key=itemgetter(1)))


def named(task: str) -> str:
    """A task's ratio with its name."""
    return f"{ratios()[task]:.0f} ({task.removeprefix('dmc_').replace('_', ' ')})"


def transfer() -> str:
    """Returns of policies here and in dm_control, from the same starts, in Markdown."""
    lines = []
    kept = json.loads((FOLDER / "transfer.json").read_text("utf-8"))
    for task, found in groupby(kept, key=itemgetter("task")):
        rows = list(found)
        differences = [row["difference"] for row in rows]
        errors = [row["difference_standard_error"] for row in rows]
        over = stdev(differences) / sqrt(len(rows)) if len(rows) > 1 else errors[0]
        lines.append(
            [
                f"`{task}`",
                ", ".join(str(row["seed"]) for row in rows),
                f"{mean(row['return'] for row in rows):.0f}",
                f"{mean(row['return_there'] for row in rows):.0f}",
                f"{round(mean(differences)):+d} ± {over:.0f}",
                ", ".join(
                    f"{one:+.0f} ± {error:.0f}"
                    for one, error in zip(differences, errors, strict=True)
                ),
            ]
        )
    columns = ["task", "seeds", "here", "in dm_control", "difference", "of each policy"]
    return table(columns, lines)


COMPARED = {
    "ours, theirs": "PixelBrax and dm_control",
    "ours, single": "the same, dm_control without multisampling",
    "ours with 4 rays, theirs": "PixelBrax with `samples=4` and dm_control",
    "single, theirs": "dm_control without and with multisampling",
    "picked, theirs": "dm_control's own colors at its four samples, averaged, and multisampling",
}


def of_pictures(pair: str, area: str) -> list[float]:
    """Mean differences of a pair of pictures over an area, by model."""
    kept = json.loads((FOLDER / "pictures.json").read_text("utf-8"))
    return [row[area] for row in kept["mean_absolute_difference_of_255"][pair].values()]


def pictures() -> str:
    """How far pictures of DM Control are from OpenGL's, in Markdown: median and range of models."""
    lines = []
    for pair, name in COMPARED.items():
        areas = (of_pictures(pair, area) for area in ("all", "else"))
        texts = (f"{median(area):.1f} ({min(area):.1f} to {max(area):.1f})" for area in areas)
        lines.append([name, *texts])
    return table(["mean difference of a color, of 255", "image", "bodies"], lines)


def picture(area: str = "all", pair: str = "ours, theirs") -> str:
    """The median of models of how far their pictures are from dm_control's."""
    return f"{median(of_pictures(pair, area)):.1f}"


PARTS = {
    "whole": "nothing",
    "sky": "the sky's texture",
    "marks": "marks on the checker",
    "light": "OpenGL's light",
    "reflection": "the reflection",
    "shadows": "shadows",
    "none": "all but shadows: `dmc-plain`",
    "four rays": "nothing, but `samples=4`",
}
"""Names of the forms in docs/dmc/parts.json."""


def parts() -> str:
    """What each part of the picture changes, and costs, in Markdown."""
    kept = json.loads((FOLDER / "parts.json").read_text("utf-8"))
    speeds, returns = kept["speed"], kept["policy"]

    def far(form: str, area: str) -> str:
        return f"{median(row[form][area] for row in kept['pictures'].values()):.1f}"

    def earned(form: str) -> str:
        if form == "whole":
            return f"{mean(returns[form]):.0f}"
        changes = [one - all_ for one, all_ in zip(returns[form], returns["whole"], strict=True)]
        return f"{mean(changes):+.0f} ± {stdev(changes) / sqrt(len(changes)):.0f}"

    def fast(form: str, task: str) -> str:
        if form == "whole":
            return number(1e3 * kept["num_envs"] / speeds[task][form])
        return number(speeds[task]["whole"] / speeds[task][form]) if form in speeds[task] else ""

    lines = []
    for form, name in PARTS.items():
        drawn = form != "four rays"
        shown = [far(form, "all"), far(form, "else"), earned(form)] if drawn else ["", "", ""]
        lines.append([name, *shown, *(fast(form, task) for task in speeds)])
    tasks = (task.removeprefix("dmc_").split("_")[0] for task in speeds)
    return table(["left out", "image", "bodies", "return", *tasks], lines)


WHOLE = partial(whole, "peers.dm_control_envs")
PICTURE = {"picture": picture, "picture-bodies": partial(picture, "else")}
FIGURES = {
    **PICTURE,
    "picture-plain": partial(picture, "all", "ours, single"),
    "picture-bodies-plain": partial(picture, "else", "ours, single"),
    "whole": WHOLE,
    "whole-share": partial(whole, "dmc.with_look", look="dmc-plain"),
    "tasks": tasks,
    "least": lambda: named(next(iter(ratios()))),
    "most": lambda: named(next(reversed(ratios()))),
    "cheetah": lambda: number(speeds("dmc_cheetah_run")[0]),
    "first-frame": partial(first_frames, "without"),
    "first-frame-kept": partial(first_frames, "with"),
    "same-state": same_state,
    "states": states,
    "part": part,
}
TRANSFER = {"transfer": transfer}
ALL = {"speed": speed, "looks": looks, "pictures": pictures, "parts": parts, "physics": physics}


LEADERBOARD = FOLDER.parent / "leaderboard"


AGENTS = {"ppo": "PPO", "drqv2": "DrQ-v2"}
"""Agents of this repository, with their presets `cpu`."""
MARKS = ("500000", "1000000")
"""Frames of published returns."""


def learned_tasks() -> list[tuple[str, str, list[dict]]]:
    """The leaderboard's tasks of DM Control and agents, with their runs."""
    return [
        (task, agent, runs)
        for (task, agent), runs in sorted(leaderboard.read_by_agent(LEADERBOARD).items())
        if task in DMC_TASKS and agent in AGENTS
    ]


def minutes(runs: list[dict]) -> list[float]:
    """Times of training, from the run that was disturbed least."""
    return sorted(run["seconds"][-1] / 60.0 for run in runs)


def span(numbers: list[float]) -> str:
    """The first and the last number, once if they are alike."""
    return " to ".join(dict.fromkeys(f"{number:.0f}" for number in (numbers[0], numbers[-1])))


def learned() -> str:
    """What agents earn at the end, beside DrQ-v2's published means, in Markdown."""
    published = leaderboard.read_published(LEADERBOARD)["DrQ-v2"]["returns"]
    lines = [
        [
            f"`{task}`",
            AGENTS[agent],
            len(runs),
            leaderboard.middle([run["return"][-1] for run in runs]),
            f"{max(run['frames'][-1] for run in runs) / 1e6:.1f}M",
            span(minutes(runs)),
            *(f"{published[task][n]:.0f}" if task in published else "" for n in MARKS),
        ]
        for task, agent, runs in learned_tasks()
    ]
    heads = ["task", "agent", "seeds", "return", "frames", "minutes"]
    return table([*heads, "published, 0.5M", "published, 1M"], lines)


def training_minutes() -> str:
    """How many tasks these are, and minutes of training over them."""
    tasks = learned_tasks()
    taken = minutes([run for *_, runs in tasks for run in runs])
    return f"{span(taken)} minutes on each of {len(tasks)} tasks of DM Control"


README = {
    **PICTURE,
    "whole": WHOLE,
    "cheetah": lambda: number(speeds("dmc_cheetah_run")[0]),
    "cheetah-ratio": lambda: f"{ratios()['dmc_cheetah_run']:.0f}",
    "slowest": lambda: named(next(iter(ratios()))),
    "fastest": lambda: named(next(reversed(ratios()))),
    "minutes": training_minutes,
    "learned": learned,
}
