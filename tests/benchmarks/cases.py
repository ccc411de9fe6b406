"""What is measured: cases as data."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

TASKS = {
    "halfcheetah": "HalfCheetah",
    "walker2d": "Walker2d",
    "ant": "Ant",
    "humanoid": "Humanoid",
}
"""Task -> its name in Gymnasium."""

DM_CONTROL = {
    "halfcheetah": "cheetah",
    "walker2d": "walker",
    "ant": "quadruped",
    "humanoid": "humanoid",
}
"""Task -> DM Control's domain of the same class."""

BATCHES = (1, 10, 100, 1000, 4096, 8192)

ORIGINAL = (
    ("halfcheetah", 4, 12.6),
    ("halfcheetah", 32, 8.7),
    ("ant", 4, 4.3),
    ("humanoid", 4, 4.4),
    ("walker2d", 4, 13.5),
)
"""Task, environments and steps per second of the original (the code of arXiv 2502.00021)
on two cores of an AMD EPYC machine whose vectors were not noted; measured once, apart."""

PEERS: dict[str, tuple[str, ...]] = {
    "dm_control": (
        "dm_control==1.0.50",
        "mujoco==3.17.0",
        "gymnasium==1.4.0",
        "stable-baselines3==2.9.2",
        "torch==2.13.0",
    ),
    "mujoco_warp": ("mujoco-warp==4.0.0", "warp-lang==1.19.0", "mujoco==4.0.0"),
    "gymnasium": ("gymnasium[mujoco]==1.4.0", "mujoco==3.17.0", "pyopengl"),
    "envpool": ("envpool==1.2.5",),
}
"""Peer -> what is installed for it, into an environment of its own."""


ABSENT = 3
"""Exit status of a worker that lacks what it is to measure."""


@dataclass(frozen=True)
class Case:
    """One measurement, made in a process of its own.

    Attributes:
        group: the part of the benchmark that it belongs to; see ``GROUPS``.
        measure: ``module.function`` of this package, or ``peers.<name>`` for a script.
        arguments: of that function.
        peer: the peer in whose environment it runs; empty for ours.
    """

    group: str
    measure: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    peer: str = ""

    @property
    def key(self) -> str:
        """Names the case in the results."""
        arguments = json.dumps(dict(self.arguments), sort_keys=True)
        return f"{self.group} {self.measure} {arguments}"


def renderers() -> Iterator[Case]:
    """The ray-caster alone: its looks, and the size of the image."""
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


def batches() -> Iterator[Case]:
    """Pixels over the number of environments, interleaved."""
    for task in TASKS:
        yield Case("batches", "interleaved.batches", {"task": task, "sizes": (100, 10, 1000)})


def sizes() -> Iterator[Case]:
    """Pixels of 64 x 64."""
    for task in TASKS:
        for num_envs in (100, 1000):
            where = {"task": task, "num_envs": num_envs, "size": 64}
            yield Case("sizes", "throughput.scan", where)
            yield Case("sizes", "throughput.renderer", where)


def original() -> Iterator[Case]:
    """The settings in which the original's speed is known."""
    for task, num_envs, _ in ORIGINAL:
        yield Case("original", "throughput.scan", {"task": task, "num_envs": num_envs})


def distractors() -> Iterator[Case]:
    """Pixels with each distractor, interleaved."""
    for task, num_envs in [("ant", 256), ("ant", 1024), *((task, 1000) for task in TASKS)]:
        yield Case("distractors", "interleaved.distractors", {"task": task, "num_envs": num_envs})


def clips() -> Iterator[Case]:
    """From a folder of images to the device."""
    yield Case("clips", "bank.load", {"size": 84})


def adapters() -> Iterator[Case]:
    """Every adapter, interleaved."""
    for task, num_envs in [("ant", 256), ("ant", 1), *((task, 1000) for task in TASKS)]:
        yield Case("adapters", "interleaved.adapters", {"task": task, "num_envs": num_envs})


def startup() -> Iterator[Case]:
    """From the import to the first frames."""
    for cache in ("none", "cold", "warm"):
        yield Case("startup", "startup.first_frame", {"task": "ant", "cache": cache})


def devices() -> Iterator[Case]:
    """One device and eight, with as many environments in all, and with as many on each."""
    for num_devices, num_envs in ((1, 64), (8, 64), (8, 512)):
        where = {"task": "ant", "num_devices": num_devices, "num_envs": num_envs}
        yield Case("devices", "throughput.sharded", where)
    for num_devices, cores, num_envs in ((1, 1, 64), (2, 2, 128), (1, 2, 128), (4, 2, 128)):
        where = {"num_devices": num_devices, "cores": cores, "num_envs": num_envs}
        yield Case("devices", "scaling.training", {"task": "inverted_pendulum", **where})


def peers() -> Iterator[Case]:
    """Others and ourselves, one after the other; all hand NumPy arrays to Python."""
    for task in TASKS:
        for num_envs in (256, 1000):
            yield Case("peers", "throughput.gymnasium", {"task": task, "num_envs": num_envs})
        for processes in (0, "cores", 32):
            where = {"task": task, "domain": DM_CONTROL[task], "processes": processes}
            yield Case("peers", "peers.dm_control_envs", where, "dm_control")
        yield Case("peers", "peers.gymnasium_envs", {"task": task}, "gymnasium")
        yield Case("peers", "peers.envpool_envs", {"task": task}, "envpool")
    for size, num_envs in ((84, 256), (84, 1024), (64, 1024), (64, 8192)):
        where = {"task": "ant", "num_envs": num_envs, "size": size}
        yield Case("peers", "throughput.renderer", where)
        yield Case("peers", "peers.mujoco_warp_renderer", where, "mujoco_warp")


GROUPS = {
    "renderer": renderers,
    "startup": startup,
    "adapters": adapters,
    "distractors": distractors,
    "clips": clips,
    "original": original,
    "peers": peers,
    "devices": devices,
    "batches": batches,
    "sizes": sizes,
    "environments": environments,
}
"""Parts of the benchmark, in the order in which they are measured."""
