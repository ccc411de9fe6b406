"""What is measured: ourselves, others, several devices, start-up, compiled programs."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pixelbrax_jax.processor import num_cores
from pixelbrax_jax.tasks import DMC_TASKS
from tests.benchmarks import runner, tables
from tests.benchmarks.ahead import tables as compiled
from tests.benchmarks.ahead.case import MUJOCO_STEPS, PROGRAMS, TRAINING, AheadCase
from tests.benchmarks.ahead.targets import CARDS
from tests.benchmarks.case import TASKS, Case, Group
from tests.benchmarks.original import ORIGINAL
from tests.benchmarks.peers.install import peer_python

HERE = "tests.benchmarks"
BATCHES = (1, 10, 100, 1000, 4096, 8192)
DM_CONTROL = {
    "halfcheetah": "cheetah",
    "walker2d": "walker",
    "ant": "quadruped",
    "humanoid": "humanoid",
}
"""Task -> DM Control's domain of the same class."""


@dataclass(frozen=True)
class PeerCase(Case):
    """A script that measures another simulator, in an environment of that one's own."""

    peer: str = ""

    def command(self) -> list[str]:
        python = peer_python(self.peer) if self.peer else sys.executable
        arguments = {**self.arguments, "cores": num_cores()}
        if self.peer == "mujoco_warp":
            describe = Case("scene", "scene.describe", {"task": arguments["task"]}, HERE)
            arguments["scene"] = runner.run_process(describe.command(), {}, 300.0)["values"]
        script = Path(__file__).parent / f"{self.measure.replace('.', '/')}.py"
        return [python, str(script), json.dumps(arguments)]


class DevicesCase(Case):
    """One for which XLA emulates devices, as many as its argument ``num_devices``."""

    def environ(self) -> dict[str, str]:
        flag = f"--xla_force_host_platform_device_count={self.arguments['num_devices']}"
        return {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flag}".strip()}


def environments() -> Iterator[Case]:
    """Steps with and without pixels, and frames alone, of every task and batch."""
    for task in TASKS:
        for num_envs in BATCHES:
            where = {"task": task, "num_envs": num_envs}
            for obs_mode in ("state", "pixels"):
                yield Case("environments", "throughput.scan", where | {"obs_mode": obs_mode})
            yield Case("environments", "throughput.renderer", where)


def peers() -> Iterator[Case]:
    """Others and ourselves, one after the other; all hand NumPy arrays to Python."""
    for task in TASKS:
        for num_envs in (256, 1000):
            yield Case("peers", "throughput.gymnasium", {"task": task, "num_envs": num_envs}, HERE)
        for processes in (0, "cores", 32):
            where = {"task": task, "domain": DM_CONTROL[task], "processes": processes}
            yield PeerCase("peers", "peers.dm_control_envs", where, peer="dm_control")
        yield PeerCase("peers", "peers.gymnasium_envs", {"task": task}, peer="gymnasium")
        yield PeerCase("peers", "peers.envpool_envs", {"task": task}, peer="envpool")
    for size, num_envs in ((84, 256), (84, 1024), (64, 1024), (64, 8192)):
        where = {"task": "ant", "num_envs": num_envs, "size": size}
        yield Case("peers", "throughput.renderer", where)
        yield PeerCase("peers", "peers.mujoco_warp_renderer", where, peer="mujoco_warp")


def dmc() -> Iterator[Case]:
    """Every task of the DM Control Suite, of ours and of dm_control, which draws without a GPU."""
    for task in DMC_TASKS:
        yield Case("dmc", "dmc.pixels", {"task": task, "num_envs": 128}, HERE)
        yield dm_control("dmc", task)


def dm_control(group: str, task: str) -> Case:
    """The task in dm_control, one environment."""
    row = DMC_TASKS[task]
    where = {"task": task, "domain": row.domain, "goal": row.task, "processes": 0}
    # The camera that the field takes; the quadruped is out of the sight of its first one.
    where |= {"camera": 2 if row.domain == "quadruped" else 0, "seconds": 1.0}
    return PeerCase(group, "peers.dm_control_envs", where)


LOOKED_AT = (
    *("cartpole_swingup", "cheetah_run", "walker_walk", "humanoid_walk", "quadruped_walk"),
    "manipulator_bring_ball",
)


def looks() -> Iterator[Case]:
    """Some of these tasks with the default look, with DM Control's whole picture, and there."""
    for task in (f"dmc_{name}" for name in LOOKED_AT):
        for look in ("dmc-plain", "dmc"):
            where = {"task": task, "num_envs": 128, "look": look}
            yield Case("dmc-look", "dmc.with_look", where, HERE)
        yield dm_control("dmc-look", task)


GROUPS = {
    "renderer": Group(
        [
            Case("renderer", "throughput.renderer", {"task": "ant", "num_envs": 256, **options})
            for options in (
                *({}, {"look": "original"}, {"shadows": True}, {"size": 64}),
                {"renderer": "reference", "num_envs": 8},
            )
        ],
        tables.renderer,
        "From link poses to packed pixels, without physics.",
    ),
    "startup": Group(
        [
            Case("startup", "startup.first_frame", {"task": "ant", "cache": cache}, HERE)
            for cache in ("none", "cold", "warm")
        ],
        tables.startup,
        "16 environments behind Gymnasium; one sample each. `gymnasium` and PixelBrax are imported "
        "first, JAX and Brax when the environment is made.",
    ),
    "adapters": Group(
        [
            Case("adapters", "adapters.compare", {"task": task, "num_envs": num_envs})
            for task, num_envs in (("ant", 256), ("ant", 1), *((task, 1000) for task in TASKS))
        ],
        tables.interleaved("num_envs", "autoreset_mode", "adapter"),
        "The ratio is relative to the JAX loop with the same autoreset mode, which waits for each "
        "step. It is a median over rounds with a 95 % bootstrap interval. In each round every "
        "adapter runs 8 to 100 steps in the same process.",
    ),
    "distractors": Group(
        [
            Case("distractors", "distractors.compare", {"task": task, "num_envs": num_envs}, HERE)
            for task, num_envs in (("ant", 256), ("ant", 1024), *((task, 1000) for task in TASKS))
        ],
        tables.interleaved("num_envs", "distractors"),
        "With a bank of 60 clips of 70 frames. Ratios are to the speed without: medians over "
        "rounds, in which all take a turn of 1 to 100 steps in one process, with bootstrap "
        "intervals of 95 %.",
    ),
    "original": Group(
        [
            Case("original", "throughput.scan", {"task": task, "num_envs": num_envs})
            for task, num_envs, _ in ORIGINAL
        ],
        tables.original,
        "A compiled loop of ours in the settings in which the speed of the original is known; "
        "that was measured apart, on two cores of an AMD EPYC whose vectors were not noted.",
    ),
    "peers": Group(
        list(peers()),
        tables.peers,
        "All hand NumPy arrays to Python. Tasks are of the same class, not the same: bodies, "
        "control steps and simulators differ. OpenGL peers draw textures and shadows, which we do "
        "not, and would be faster with a GPU; this compares what a machine without one can do. "
        "MuJoCo Warp draws the same model in the same pose from our camera, without textures and "
        "shadows.",
    ),
    "dmc": Group(
        list(dmc()),
        tables.dmc,
        "128 environments through `gymnasium.make_vec`, 84 x 84, three frames, NumPy arrays; "
        "dm_control has one environment and one frame in one process, and draws through a software "
        "OpenGL, which a GPU would speed up. To the first frame: from the start of a Python "
        "process to the end of the first step of 128 environments, one sample, with an empty "
        "compilation cache and with one that such a process has filled.",
    ),
    "dmc-look": Group(
        list(looks()),
        tables.looks,
        "As `dmc`, with the default look and with the whole picture of DM Control.",
    ),
    "devices": Group(
        [
            DevicesCase(
                "devices",
                "scaling.training",
                {
                    "num_devices": num_devices,
                    "cores": cores,
                    "num_envs": num_envs,
                    "task": "inverted_pendulum",
                },
                HERE,
            )
            for num_devices, cores, num_envs in ((1, 1, 64), (2, 2, 128), (1, 2, 128), (4, 2, 128))
        ],
        tables.devices,
        "Training, PPO's preset `ci`. Emulated devices share the cores of the machine. Ideal is "
        "the speed of one device on one core times the number of cores.",
    ),
    "batches": Group(
        [
            Case("batches", "batches.compare", {"task": task, "sizes": (100, 10, 1000)}, HERE)
            for task in TASKS
        ],
        tables.interleaved("num_envs"),
        "A compiled loop over steps. Ratios are to the first line of a task: medians over rounds, "
        "in which all take a turn of 16,000 environment steps in one process, with bootstrap "
        "intervals of 95 %.",
    ),
    "environments": Group(
        list(environments()),
        tables.environments,
        "A compiled loop over steps that returns no observations.",
    ),
    "gpu-program": Group(
        [
            AheadCase(
                "gpu-program",
                "compiling.gpu",
                {"task": task, "program": program, "num_envs": num_envs, "card": card},
            )
            for card in CARDS
            for num_envs in (1024, 8192)
            for task in TASKS
            for program in PROGRAMS
        ]
        + [AheadCase("gpu-program", "compiling.gpu", where) for where in MUJOCO_STEPS + TRAINING],
        compiled.gpu,
        "Compiled, not run. Parts for the host are launched one after the other, a loop outside a "
        "graph among them as one; 1 is one CUDA graph. A loop of unknown length counts as one "
        "turn; outside a graph the host waits for it. Bytes count what every kernel reads and "
        "writes once. The model takes a kernel's bytes at the bandwidth of the card's data sheet, "
        "and 1.5 us at least: it compares forms of a program, and is no measurement.",
    ),
    "tpu-program": Group(
        [
            AheadCase(
                "tpu-program",
                "compiling.tpu",
                {"task": task, "program": program, "num_envs": 1024},
                platform="tpu",
            )
            for task in ("inverted_pendulum", *TASKS)
            for program in ("renderer", "step")
        ],
        compiled.tpu,
        "Compiled for a chip of a TPU v5e, not run. Bytes and times are the estimates of XLA.",
    ),
}
"""Parts of the whole benchmark, in the order in which they are measured."""
