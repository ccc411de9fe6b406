"""Pages of docs/tasks: rewards, observations, time steps, actions and cameras of every task.

Names, numbers and units come from the models and the code. What the numbers mean stands beside the
formulas: in the docstrings of a MuJoCo task's functions, and in the rows of Brax's tasks. Such a
text may have ``{expressions}`` of the function's module, its keywords and ``model``. An entry of an
observation is ``* ``expression`` text``; the expression gives labels, or a number of entries.
"""

from __future__ import annotations

import inspect
import json
import re
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

DOCS = Path(__file__).parents[2] / "docs"

Label = tuple[str, str]
"""Name and unit of an entry."""

_ENTRY = re.compile(r"^\s*\* ``(.+?)``[ ;,:]*(.*)$")
_JOINTS, _SENSORS = mujoco.mjtJoint, mujoco.mjtSensor
_UNITS = {
    "TOUCH": "N",
    "FORCE": "N",
    "TORQUE": "N m",
    "ACCELEROMETER": "m/s²",
    "VELOCIMETER": "m/s",
    "GYRO": "rad/s",
    "FRAMEPOS": "m",
    "SUBTREELINVEL": "m/s",
}


@dataclass(frozen=True)
class Labels:
    """Names and units of what a task's formulas read, by the names that they use."""

    model: mujoco.MjModel

    @property
    def qpos(self) -> list[Label]:
        found: list[Label] = []
        for i in range(self.model.njnt):
            name, kind = self._joint(i), int(self.model.jnt_type[i])
            if kind == _JOINTS.mjJNT_FREE:
                found += [(f"{name}.{axis}", "m") for axis in "xyz"]
            if kind in (_JOINTS.mjJNT_FREE, _JOINTS.mjJNT_BALL):
                found += [(f"{name}.q{axis}", "quaternion") for axis in "wxyz"]
            else:
                found.append((name, "m" if kind == _JOINTS.mjJNT_SLIDE else "rad"))
        return found

    @property
    def qvel(self) -> list[Label]:
        found: list[Label] = []
        for i in range(self.model.njnt):
            name, kind = self._joint(i), int(self.model.jnt_type[i])
            if kind == _JOINTS.mjJNT_FREE:
                found += [(f"{name}.v{axis}", "m/s") for axis in "xyz"]
            if kind in (_JOINTS.mjJNT_FREE, _JOINTS.mjJNT_BALL):
                found += [(f"{name}.w{axis}", "rad/s") for axis in "xyz"]
            else:
                found.append((name, "m/s" if kind == _JOINTS.mjJNT_SLIDE else "rad/s"))
        return found

    @property
    def act(self) -> list[Label]:
        return [(self.model.actuator(i).name, "activation") for i in range(self.model.na)]

    def joint_pos(self, *names: str) -> list[Label]:
        return [self.qpos[self.model.joint(name).qposadr[0]] for name in names]

    def joint_vel(self, *names: str) -> list[Label]:
        return [self.qvel[self.model.joint(name).dofadr[0]] for name in names]

    def sensor(self, *names: str) -> list[Label]:
        found: list[Label] = []
        for name in names:
            sensor = self.model.sensor(name)
            kind = _SENSORS(int(sensor.type[0])).name.removeprefix("mjSENS_")
            joint = self.model.joint(int(sensor.objid[0])) if kind.startswith("JOINT") else None
            if joint is not None:
                slides = int(joint.type[0]) == _JOINTS.mjJNT_SLIDE
                unit = ("m" if slides else "rad") + ("/s" if kind == "JOINTVEL" else "")
            else:
                unit = _UNITS[kind]
            axes = [f"{name}.{axis}" for axis in "xyz"] if sensor.dim[0] == 3 else [name]
            found += [(axis, unit) for axis in axes]
        return found

    def sensors_of(self, *kinds: str) -> list[Label]:
        wanted = [int(getattr(_SENSORS, f"mjSENS_{kind}")) for kind in kinds]
        rows = [i for i, kind in enumerate(self.model.sensor_type) if int(kind) in wanted]
        return self.sensor(*(self.model.sensor(i).name for i in rows))

    def _joint(self, i: int) -> str:
        body = self.model.body(int(self.model.jnt_bodyid[i])).name
        return self.model.joint(i).name or f"{body}/{i - self.model.body(body).jntadr[0]}"

    def names(self) -> dict[str, Any]:
        """What an expression may use."""
        public = (name for name in dir(self) if not name.startswith("_") and name != "names")
        return {name: getattr(self, name) for name in public}


@dataclass(frozen=True)
class Text:
    """What a formula says of itself: its docstring, or a row's text, with its names."""

    text: str
    names: Mapping[str, Any]
    keywords: Mapping[str, Any]

    @classmethod
    def of(cls, formula: Callable[..., Any], names: Mapping[str, Any]) -> Text:
        keywords: dict[str, Any] = {}
        while isinstance(formula, partial):
            keywords, formula = formula.keywords | keywords, formula.func
        text = inspect.cleandoc(formula.__doc__ or "")
        return cls(text, formula.__globals__ | keywords | names, keywords)

    def sentence(self) -> str:
        """All of it, without the verb, its expressions evaluated."""
        text = re.sub(r"^Return (whether )?", "", " ".join(self.text.split()))
        return self._filled(text).replace("``", "`").rstrip(".")

    def entries(self) -> Iterator[tuple[int, str]]:
        """Numbers and meanings of the entries of an observation, in order."""
        for line in self.text.splitlines():
            if not (found := _ENTRY.match(line)):
                continue
            value = eval(found[1], dict(self.names))
            text = self._filled(found[2]).replace("``", "`")
            if callable(value):
                yield from Text.of(value, self.names).entries()
            elif isinstance(value, int):
                yield value, text
            else:
                yield len(value), ", ".join(filter(None, (listed(value), text)))

    def _filled(self, text: str) -> str:
        def fill(found: re.Match[str]) -> str:
            code, _, form = found[1].partition("!")
            return format(eval(code, dict(self.names)), form)

        return re.sub(r"\{([^}]+)\}", fill, text)


def listed(labels: list[Label]) -> str:
    """Names with their units, those of one unit together."""
    parts = []
    for unit, group in groupby(labels, key=lambda label: label[1]):
        parts.append(", ".join(f"`{name}`" for name, _ in group) + f" ({unit})")
    return ", ".join(parts)


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


def actuators(task: Described) -> str:
    """What actions do, those that do the same together."""
    model, env = task.model, getattr(task.physics, "_source", None)
    ranges = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [[-1, 1]])
    gears, scaled = model.actuator_gear[:, 0], True
    if env is not None:
        gears = np.asarray(env.unwrapped.sys.actuator.gear)
        scaled = task.row.paper_unscaled
    effects = []
    for i in range(model.nu):
        joint = model.actuator_trnid[i, 0]
        by_joint = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        target = Labels(model)._joint(joint) if by_joint else model.tendon(int(joint)).name
        slides = by_joint and model.jnt_type[joint] == _JOINTS.mjJNT_SLIDE
        low, high = ranges[i] if scaled else (max(-1, ranges[i, 0]), min(1, ranges[i, 1]))
        _, stiffness, damping = model.actuator_biasprm[i, :3]
        gain = model.actuator_gainprm[i, 0]
        if stiffness:
            kind, reach = (
                "position",
                _range(low, high, "" if not by_joint else "m" if slides else "rad"),
            )
        elif damping:
            kind, reach = "velocity", _range(low, high, "m/s" if slides else "rad/s")
        else:
            unit = ("N" if slides else "N m") if by_joint else "on the tendon"
            kind = "force" if slides or not by_joint else "torque"
            reach = _range(low * gain * gears[i], high * gain * gears[i], unit)
        effects.append(((kind, reach, bool(model.actuator_dyntype[i])), target))
    parts = []
    for (kind, reach, filtered), group in groupby(effects, key=lambda effect: effect[0]):
        names = ", ".join(f"`{target}`" for _, target in group)
        parts.append(f"{kind} {names} {reach}" + (", filtered" if filtered else ""))
    control = " or ".join(dict.fromkeys(_range(*ends) for ends in ranges)) if scaled else "±1"
    mapped = "" if control == "±1" else f", mapped to controls u ({control})"
    return f"{model.nu} in [-1, 1]{mapped}: " + "; ".join(parts)


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


def paper(task: Described) -> list[str]:
    """What the reward preset "paper" changes."""
    row, changes = task.row, []
    if row.paper_reward:
        reward = Text.of(_PAPER_REWARDS[row.paper_reward], {})
        changes.append(f"the reward is {reward.sentence()}")
    changes += [f"{name} {value:g}" for name, value in row.paper_options.items()]
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
    heads = ["Gymnasium id", "in JAX", "goal"]
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
            end, repeat = kept["random"], kept["settings"]["action_repeat"]
            random = f"{end['return']:,.0f} ± {end['standard_error']:,.0f} (action repeat {repeat})"
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


def _of_mujoco(
    rows: Mapping[str, Any], formulas: Mapping[str, Any], random: Callable[[str], str]
) -> list[Described]:
    found = []
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
                random(name),
            )
        )
    return found


@cache
def dmc() -> list[Described]:
    """Tasks of the DM Control Suite."""
    kept = _read("dmc/physics.json")["tasks"]
    return _of_mujoco(
        DMC_TASKS,
        DMC_FORMULAS,
        lambda name: f"{kept[name]['episode']['return']:.3g}" if name in kept else "",
    )


@cache
def gym() -> list[Described]:
    """Gymnasium's MuJoCo tasks."""
    return _of_mujoco(GYM_TASKS, GYM_FORMULAS, lambda name: "")


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
