"""Programs for an H100 and a TPU v5e stay as good as they were; run with `make test-programs`.

Compiled, not run. The compilers are installed at the first time: 600 MB for the H100, 500 MB for
the TPU.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import jax
import pytest

from tests.benchmarks import runner
from tests.benchmarks.ahead.case import MUJOCO_STEPS, TRAINING, AheadCase

pytestmark = [pytest.mark.gpu_program, pytest.mark.timeout(900)]

KEPT = Path(__file__).parents[1] / "docs" / "benchmarks" / "programs.json"
N = 1024
SPILLED = 0 if jax.version.__version_info__ < (0, 12) else None
"""Bytes; XLA writes no PTX from jax 0.12 on, where they are not known."""


@cache
def compiled(task: str, program: str, platform: str = "cuda", **options: Any) -> dict[str, Any]:
    """What the compiler made of a program."""
    measure = "compiling.gpu" if platform == "cuda" else "compiling.tpu"
    where = {"task": task, "program": program, "num_envs": N, **options}
    if platform == "cuda":
        where["card"] = "H100"
    with pytest.MonkeyPatch.context() as patch:
        # The tests' own compile without optimisation.
        patch.delenv("XLA_FLAGS", raising=False)
        outcome = runner.measure(AheadCase("guard", measure, where, platform=platform), 600.0)
    if outcome["status"] == "absent":
        pytest.skip(outcome["why"])
    assert outcome["status"] == "ok", outcome.get("why")
    return outcome["values"]


def kept(task: str, program: str, **options: Any) -> dict[str, Any] | None:
    """The same of the kept report; None if that is of another JAX."""
    report = json.loads(KEPT.read_text("utf-8"))
    where = {"task": task, "program": program, "num_envs": N, "card": "H100", **options}
    for row in report["cases"].values():
        release = report["machines"][row["machine"]]["versions"]["jax"]
        if row["arguments"] == where and release == jax.__version__:
            return row["values"]
    return None


@pytest.mark.parametrize("task", ["ant", "halfcheetah"])
def test_the_renderer_is_one_large_kernel(task):
    values = compiled(task, "renderer")
    assert values["large_kernels"] == 1
    assert values["launches"] <= 8
    assert values["temporary_bytes"] <= 0.3 * values["output_bytes"]
    assert values["read_bytes"] + values["written_bytes"] <= 1.2 * values["output_bytes"]
    assert values["spilled"] == SPILLED


@pytest.mark.parametrize(
    ("options", "large"),
    [
        ({"shadows": True}, 1),
        ({"distractors": "paper-video", "clips": "procedural"}, 2),
        ({"distractors": "dcs-hard", "clips": "procedural", "shadows": True}, 2),
    ],
    ids=["shadows", "video over all", "all distractors and shadows"],
)
def test_distractors_and_shadows_are_part_of_that_kernel(options, large):
    values = compiled("ant", "renderer", **options)
    assert values["large_kernels"] == large, "of a video one gathers the pixels"
    assert values["spilled"] == SPILLED


@pytest.mark.parametrize("task", ["dmc_cartpole_swingup", "dmc_walker_walk"])
def test_the_whole_picture_of_dm_control_is_one_large_kernel(task):
    values = compiled(task, "renderer", look="dmc")
    assert values["large_kernels"] == 1
    assert values["read_bytes"] + values["written_bytes"] <= 1.2 * values["output_bytes"]
    assert values["spilled"] == SPILLED


def test_samples_are_drawn_by_the_kernel_and_averaged():
    values = compiled("ant", "renderer", samples=4)
    assert values["large_kernels"] == 2
    assert values["host_steps"] == 1
    assert values["temporary_bytes"] <= 4.2 * values["output_bytes"], "four rays of four bytes"
    assert values["spilled"] == SPILLED


@pytest.mark.parametrize("program", ["state step", "step"])
def test_a_step_launches_no_more_than_it_did(program):
    values = compiled("ant", program)
    assert values["unknown_loops"] == 0
    assert values["host_steps"] == 1
    before = kept("ant", program)
    if before is None:
        pytest.skip(f"no report of jax {jax.__version__} is kept")
    assert values["launches"] <= 1.1 * before["launches"]
    assert values["longest_chain"] <= 1.1 * before["longest_chain"]


@pytest.mark.parametrize("where", MUJOCO_STEPS, ids=str)
def test_a_step_of_mujoco_xla_is_one_graph(where):
    options = {name: x for name, x in where.items() if name not in ("num_envs", "card")}
    values = compiled(**options)
    assert values["host_steps"] == 1
    before = kept(**options)
    if before is None:
        pytest.skip(f"no report of jax {jax.__version__} is kept")
    assert values["launches"] <= 1.1 * before["launches"]


@pytest.mark.parametrize("where", TRAINING, ids=str)
def test_an_iteration_of_training_launches_no_more_than_it_did(where):
    options = {name: x for name, x in where.items() if name not in ("num_envs", "card")}
    before = kept(**options, num_envs=where["num_envs"])
    if before is None:
        pytest.skip(f"no report of jax {jax.__version__} is kept")
    values = compiled(**options, num_envs=where["num_envs"])
    assert values["host_steps"] <= before["host_steps"]
    assert values["launches"] <= 1.1 * before["launches"]


def test_pixels_add_few_launches_to_a_step():
    pixels, state = compiled("ant", "step"), compiled("ant", "state step")
    assert pixels["launches"] <= state["launches"] + 12
    assert pixels["temporary_bytes"] <= 0.3 * pixels["output_bytes"]


def test_a_tpu_has_its_program():
    values = compiled("inverted_pendulum", "renderer", "tpu")
    assert values["temporary_bytes"] <= 0.3 * values["output_bytes"]
