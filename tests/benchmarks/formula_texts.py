"""What formulas of tasks say of themselves: texts with names, units and numbers of the models.

A text is the docstring of a MuJoCo task's function, or of a Brax task's row. It may have
``{expressions}`` of the function's module, its keywords and ``model``; ``!`` begins their format.
An entry of an observation is ``* ``expression`` text``; the expression gives labels, or a number of
entries, or another function with entries.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import Any

import mujoco

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
            name, kind = self.joint(i), int(self.model.jnt_type[i])
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
            name, kind = self.joint(i), int(self.model.jnt_type[i])
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
                unit = _UNITS.get(kind, "")
            axes = [f"{name}.{axis}" for axis in "xyz"] if sensor.dim[0] == 3 else [name]
            found += [(axis, unit) for axis in axes]
        return found

    def sensors_of(self, *kinds: str) -> list[Label]:
        wanted = [int(getattr(_SENSORS, f"mjSENS_{kind}")) for kind in kinds]
        rows = [i for i, kind in enumerate(self.model.sensor_type) if int(kind) in wanted]
        return self.sensor(*(self.model.sensor(i).name for i in rows))

    def joint(self, i: int) -> str:
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
        names = ", ".join(f"`{name}`" for name, _ in group)
        parts.append(f"{names} ({unit})" if unit else names)
    return ", ".join(parts)
