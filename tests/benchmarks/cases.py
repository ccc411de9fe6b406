"""What is measured: cases as data."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

TASKS = {"halfcheetah": "HalfCheetah", "walker2d": "Walker2d", "ant": "Ant", "humanoid": "Humanoid"}
"""Task -> its name in Gymnasium."""

BATCHES = (1, 10, 100, 1000, 4096, 8192)

PEERS: dict[str, tuple[str, ...]] = {
    "dm_control": (
        "dm_control==1.0.50",
        "mujoco==3.17.0",
        "gymnasium==1.4.0",
        "stable-baselines3==2.9.2",
        "torch==2.13.0",
    ),
    "mujoco_warp": ("mujoco-warp==4.0.0", "warp-lang==1.19.0", "mujoco==4.0.0"),
    "gymnasium": ("gymnasium[mujoco]==1.4.0", "mujoco==3.17.0"),
    "envpool": ("envpool==1.2.5", "numpy"),
}
"""Peer -> what is installed for it, into an environment of its own."""


@dataclass(frozen=True)
class Case:
    """One measurement, made in a process of its own.

    Attributes:
        group: the part of the benchmark that it belongs to; see ``GROUPS``.
        measure: ``module.function`` of this package, or ``peers.<name>`` for a script.
        arguments: of that function.
        peer: the peer in whose environment it runs; empty for ours.
        scene: the task whose model and camera are handed to a peer's script, if any.
    """

    group: str
    measure: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    peer: str = ""
    scene: str = ""

    @property
    def key(self) -> str:
        """Names the case in the results."""
        arguments = json.dumps(dict(self.arguments), sort_keys=True)
        return f"{self.group} {self.measure} {arguments}"


def renderers() -> Iterator[Case]:
    """The ray-caster alone: its looks, and the size of the picture."""
    for options in (
        {},
        {"look": "original"},
        {"shadows": True},
        {"size": 64},
        {"renderer": "reference", "num_envs": 8},
    ):
        yield Case("renderer", "throughput.renderer", {"task": "ant", "num_envs": 256, **options})


def environments() -> Iterator[Case]:
    """State only, rendering only and pixels, over the number of environments."""
    for task in TASKS:
        for num_envs in BATCHES:
            where = {"task": task, "num_envs": num_envs}
            yield Case("environments", "throughput.scan", {**where, "obs_mode": "state"})
            yield Case("environments", "throughput.renderer", where)
            yield Case("environments", "throughput.scan", {**where, "obs_mode": "pixels"})


def sizes() -> Iterator[Case]:
    """Pixels of 64 x 64."""
    for task in TASKS:
        for num_envs in (100, 1000):
            yield Case("sizes", "throughput.scan", {"task": task, "num_envs": num_envs, "size": 64})


def distractors() -> Iterator[Case]:
    """Pixels with each distractor, all taking turns."""
    for task, num_envs in [("ant", 256), ("ant", 1024), *((t, 1000) for t in TASKS)]:
        yield Case("distractors", "turns.distractors", {"task": task, "num_envs": num_envs})


def doors() -> Iterator[Case]:
    """Every door, all taking turns."""
    for task, num_envs in [("ant", 256), ("ant", 1), *((t, 1000) for t in TASKS)]:
        yield Case("doors", "turns.doors", {"task": task, "num_envs": num_envs})


def startup() -> Iterator[Case]:
    """From the import to the first frames."""
    for cache in ("none", "cold", "warm"):
        yield Case("startup", "startup.first_frame", {"task": "ant", "cache": cache})


def devices() -> Iterator[Case]:
    """The same environments over several emulated devices."""
    for num_devices in (1, 8):
        yield Case("devices", "throughput.sharded", {"task": "ant", "num_devices": num_devices})


def peers() -> Iterator[Case]:
    """Others and ourselves, one after the other."""
    pairs = (("halfcheetah", "cheetah"), ("walker2d", "walker"), ("ant", "quadruped"))
    for task, domain in (*pairs, ("humanoid", "humanoid")):
        for num_envs in (256, 1000):
            where = {"task": task, "num_envs": num_envs}
            yield Case("peers", "throughput.scan", {**where, "obs_mode": "pixels"})
        for processes in (0, "cores", 32):
            yield Case(
                "peers",
                "peers.dm_control_envs",
                {"domain": domain, "processes": processes},
                "dm_control",
            )
        yield Case("peers", "peers.gymnasium_envs", {"task": task}, "gymnasium")
        yield Case("peers", "peers.envpool_envs", {"task": task}, "envpool")
    for num_envs in (256, 1024):
        where = {"task": "ant", "num_envs": num_envs}
        yield Case("peers", "throughput.renderer", where)
        yield Case("peers", "peers.mujoco_warp_renderer", where, "mujoco_warp", "ant")


GROUPS = {
    "renderer": renderers,
    "startup": startup,
    "doors": doors,
    "distractors": distractors,
    "peers": peers,
    "devices": devices,
    "sizes": sizes,
    "environments": environments,
}
"""Parts of the benchmark, in the order in which they are measured."""
