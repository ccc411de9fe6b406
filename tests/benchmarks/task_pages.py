"""Pages of docs/tasks: rewards, observations, time steps, actions and cameras of every task.

Names, numbers and units come from the models and the code, and what they mean from texts beside the
formulas, see ``formula_texts``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from itertools import groupby
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from pixelbrax_gym.bench.tables import table
from pixelbrax_jax.physics.brax.loading import _PAPER_REWARDS
from pixelbrax_jax.physics.dmc.domains import FORMULAS as DMC_FORMULAS
from pixelbrax_jax.physics.gym.formulas import FORMULAS as GYM_FORMULAS
from pixelbrax_jax.physics.mujoco.formulas import never
from pixelbrax_jax.registry import make_physics
from pixelbrax_jax.tasks import BRAX_TASKS, DMC_TASKS, GYM_TASKS
from pixelbrax_jax.types import CameraRig
from tests.benchmarks.formula_texts import Labels, Text

DOCS = Path(__file__).parents[2] / "docs"

_JOINTS = mujoco.mjtJoint


@dataclass(frozen=True)
class Described:
    """A task, and what its formulas say."""

    row: Any
    physics: Any
    reward: Text
    ends: str
    observation: Text
    substeps: int
    random: str

    @property
    def model(self) -> mujoco.MjModel:
        return self.physics._model


def observed(task: Described) -> list[str]:
    """Which entries of the observation mean what, in Markdown."""
    lines, first = [], 0
    for size, text in task.observation.entries():
        span = f"{first} to {first + size - 1}" if size > 1 else str(first)
        lines.append(f"    * {span}: {text}.")
        first += size
    return lines


def num_observed(task: Described) -> int:
    """How many entries the text tells of."""
    return sum(size for size, _ in task.observation.entries())


def _number(value: float) -> str:
    return f"{float(value):.4g}"


def _range(low: float, high: float, unit: str = "") -> str:
    bounds = f"±{_number(high)}" if low == -high else f"{_number(low)} to {_number(high)}"
    return f"{bounds} {unit}".strip()


def _effect(
    model: mujoco.MjModel, i: int, bounds: tuple[float, float], gear: float
) -> tuple[tuple[str, str], str]:
    """What an actuator does and how far, and its joint, tendon or site."""
    at, trn = int(model.actuator_trnid[i, 0]), mujoco.mjtTrn(int(model.actuator_trntype[i]))
    by_joint = trn in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    if by_joint:
        target, is_slide = Labels(model).joint(at), model.jnt_type[at] == _JOINTS.mjJNT_SLIDE
    else:
        is_tendon = trn == mujoco.mjtTrn.mjTRN_TENDON
        target, is_slide = (model.tendon(at) if is_tendon else model.site(at)).name, True
    _, stiffness, damping = model.actuator_biasprm[i, :3]
    if stiffness:
        effect, unit = "position", ("m" if is_slide else "rad") if by_joint else ""
    elif damping:
        effect, unit = "velocity", ("m/s" if is_slide else "rad/s") if by_joint else ""
    else:
        effect, unit = ("force", "N") if is_slide else ("torque", "N m")
        scale = model.actuator_gainprm[i, 0] * gear
        bounds = bounds[0] * scale, bounds[1] * scale
    filtered = ", filtered" if model.actuator_dyntype[i] else ""
    return (effect, _range(*bounds, unit) + filtered), target


def actuators(task: Described) -> str:
    """What actions do, those that do the same together."""
    model, env = task.model, getattr(task.physics, "_source", None)
    limited = model.actuator_ctrllimited[:, None].astype(bool)
    ranges = np.where(limited, model.actuator_ctrlrange, [[-1.0, 1.0]])
    gears = model.actuator_gear[:, 0]
    if env is not None:
        gears = np.asarray(env.unwrapped.sys.actuator.gear)
        if not task.row.paper_unscaled:
            ranges = np.clip(ranges, -1.0, 1.0)
    effects = [
        _effect(model, i, (float(low), float(high)), float(gears[i]))
        for i, (low, high) in enumerate(ranges)
    ]
    parts = []
    for (effect, reach), group in groupby(effects, key=lambda effect: effect[0]):
        parts.append(f"{effect} {', '.join(f'`{target}`' for _, target in group)} {reach}")
    control = " or ".join(dict.fromkeys(_range(*bounds) for bounds in ranges))
    mapped = "" if control == "±1" else f", mapped to controls u ({control})"
    return f"{model.nu} in [-1, 1]{mapped}: {'; '.join(parts)}"


def cameras(task: Described) -> str:
    """The model's cameras, the default first, and those that are missing."""
    rigs: Mapping[str, CameraRig] = task.physics.rigs
    default = rigs["default"]
    same = [name for name, rig in rigs.items() if name != "default" and _equal(rig, default)]
    others = [name for name in rigs if name not in (*same, "default")]
    shown = [f"`{name}`" for name in same] or ["`default`"]
    text = f"{', '.join(shown)} (default)" + "".join(f", `{name}`" for name in others)
    missing = [f"`{name}`: {why}" for name, why in task.physics.unfit_cameras.items()]
    return text + (f". Missing: {'; '.join(missing)}" if missing else "")


def _equal(one: CameraRig, other: CameraRig) -> bool:
    leaves = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return one.link == other.link and all(np.array_equal(*pair) for pair in leaves)


def timing(task: Described) -> str:
    """Control and physics time steps."""
    step, limit = task.physics.dt / task.substeps, task.physics.time_limit or 1000
    parts = f"{task.substeps} physics steps of {_number(step)} s"
    if task.substeps == 1:
        parts = "one physics step"
    if task.physics.backend != "mujoco":
        parts += f" (backend `{task.physics.backend}`)"
    return f"{_number(task.physics.dt)} s a control step, {parts}; {limit} control steps an episode"


def alike(
    tasks: list[Described], text: Callable[[Described], str]
) -> Iterator[tuple[str, list[Described]]]:
    """Texts in order, each with the tasks that have it."""
    found: dict[str, list[Described]] = {}
    for task in tasks:
        found.setdefault(text(task), []).append(task)
    yield from found.items()


def rewards(tasks: list[Described]) -> list[str]:
    """Each formula, with the tasks that have it if there are several."""
    lines = []
    for text, same in alike(tasks, lambda task: task.reward.sentence()):
        if len(tasks) == 1:
            return [f"* **Reward**: {text}."]
        names = ", ".join(f"`{task.row.name}`{_keywords(task, len(same))}" for task in same)
        lines.append(f"    * {names}: {text}.")
    return ["* **Reward**:", "", *lines, ""]


def _keywords(task: Described, count: int) -> str:
    if count == 1 or not task.reward.keywords:
        return ""
    return f" ({', '.join(f'{k} {v:g}' for k, v in task.reward.keywords.items())})"


_PAPER_OPTIONS = {"forward_reward_weight": "v counts {:g} times"}


def paper(task: Described) -> list[str]:
    """What the reward preset "paper" changes."""
    row, changes = task.row, []
    if row.paper_reward:
        reward = Text.of(_PAPER_REWARDS[row.paper_reward], {})
        changes.append(f"the reward is {reward.sentence()}")
    changes += [_PAPER_OPTIONS[name].format(value) for name, value in row.paper_options.items()]
    if row.paper_unscaled:
        changes.append("u is the action itself; actuators clip it to their range")
    return [f'* **Paper** (`reward_preset="paper"`): {"; ".join(changes)}.'] if changes else []


def named(tasks: list[Described], count: int) -> str:
    """The tasks of which something is so, if it is not so of all."""
    return "" if len(tasks) == count else " of " + ", ".join(f"`{task.row.name}`" for task in tasks)


def fact(title: str, tasks: list[Described], text: Callable[[Described], str]) -> list[str]:
    """A line for all tasks, or one for each text."""
    found = alike(tasks, text)
    return [f"* **{title}**{named(same, len(tasks))}: {told}." for told, same in found]


def section(title: str, tasks: list[Described]) -> str:
    """One model's tasks."""
    first = tasks[0]
    heads = ["Gymnasium id", "name", "goal"]
    lines = [[f"`{t.row.gymnasium_id}`", f"`{t.row.name}`", t.row.summary] for t in tasks]
    if any(task.random for task in tasks):
        heads.append("return of random actions")
        lines = [[*line, task.random] for line, task in zip(lines, tasks, strict=True)]
    parts = [f"## {title}", "", table(heads, lines), "", *rewards(tasks)]
    if hasattr(first.row, "paper_options"):
        parts += paper(first)
    parts += [
        *fact("Time", tasks, timing),
        *fact("Ends earlier", tasks, lambda task: task.ends),
        *fact("Actions", tasks, actuators),
        *fact("Cameras", tasks, cameras),
    ]
    for lines, same in alike(tasks, lambda task: "\n".join(observed(task))):
        of = named(same, len(tasks))
        parts += [f'* **Observation**{of} (`obs_mode="state"`), {num_observed(same[0])} numbers:']
        parts += ["", lines, ""]
    return "\n".join(parts)


def _read(name: str) -> dict[str, Any]:
    return json.loads((DOCS / name).read_text("utf-8"))


def _random(kept: Mapping[str, Any]) -> str:
    end = kept["random"]
    digits = max(0, -math.floor(math.log10(end["standard_error"] or 1.0)))
    return f"{end['return']:,.{digits}f} ± {end['standard_error']:,.{digits}f}"


@cache
def brax() -> list[Described]:
    """Brax's tasks."""
    earned, found = _read("results/untrained.json"), []
    for name, row in BRAX_TASKS.items():
        physics = make_physics(name)
        env = physics._source.unwrapped
        names = Labels(physics._model).names() | {"physics": physics}
        random = ""
        if kept := earned.get(f"{name}-brax"):
            random = f"{_random(kept)} (action repeat {kept['settings']['action_repeat']})"
        found.append(
            Described(
                row,
                physics,
                Text(row.reward, names, {}),
                row.ends or "never",
                Text("\n".join(f"* {entry}" for entry in row.observation), names, {}),
                env._n_frames,
                random,
            )
        )
    return found


def _of_mujoco(rows: Mapping[str, Any], formulas: Mapping[str, Any]) -> list[Described]:
    earned, found = _read("results/untrained.json"), []
    for name, row in rows.items():
        physics, formula = make_physics(name), formulas[name]
        names = Labels(physics._model).names()
        ends = "never"
        if formula.terminated is not never:
            ends = "when " + Text.of(formula.terminated, names).sentence()
        found.append(
            Described(
                row,
                physics,
                Text.of(formula.reward, names),
                ends,
                Text.of(formula.observe, names),
                formula.substeps,
                _random(earned[name]) if name in earned else "",
            )
        )
    return found


@cache
def dmc() -> list[Described]:
    """Tasks of the DM Control Suite."""
    return _of_mujoco(DMC_TASKS, DMC_FORMULAS)


@cache
def gym() -> list[Described]:
    """Gymnasium's MuJoCo tasks."""
    return _of_mujoco(GYM_TASKS, GYM_FORMULAS)


def _title(task: Described) -> str:
    if domain := getattr(task.row, "domain", ""):
        return domain.replace("_", " ").capitalize()
    return task.row.gymnasium_id.split("/")[1].removeprefix("Gym-").rpartition("-")[0]


def page(tasks: Callable[[], list[Described]]) -> str:
    """All sections of a page."""
    return "\n".join(section(title, list(group)) for title, group in groupby(tasks(), key=_title))


FIGURES = {
    name: {"sections": partial(page, suite)}
    for name, suite in (("brax", brax), ("dmc", dmc), ("gymnasium", gym))
}
