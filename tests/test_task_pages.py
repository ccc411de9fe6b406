"""The pages of tasks: every task says what it rewards and observes, entry by entry."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from pixelbrax_jax.physics.dmc.formulas import rising, small_control, tolerance
from pixelbrax_jax.tasks import BRAX_TASKS, DMC_TASKS, GYM_TASKS, TASKS
from tests.benchmarks import task_pages
from tests.benchmarks.formula_texts import Text

SUITES = {"brax": BRAX_TASKS, "dmc": DMC_TASKS, "gymnasium": GYM_TASKS}
DESCRIBED = {"brax": task_pages.brax, "dmc": task_pages.dmc, "gymnasium": task_pages.gym}


def test_every_suite_has_a_page():
    assert {name for suite in SUITES.values() for name in suite} == set(TASKS)
    assert set(task_pages.FIGURES) == set(SUITES)


def test_pages_count_dm_controls_tasks():
    texts = [
        Path(__file__).parents[1].joinpath(n).read_text("utf-8")
        for n in ("README.md", "docs/dmc.md")
    ]
    counts = [
        int(n) for text in texts for n in re.findall(r"(\d+) tasks of the \[?DM Control", text)
    ]
    assert counts == [len(DMC_TASKS)] * 3


@pytest.mark.parametrize("suite", SUITES)
def test_every_task_says_what_it_rewards_and_observes(suite):
    described = DESCRIBED[suite]()
    assert [task.row.name for task in described] == list(SUITES[suite])
    for task in described:
        name = task.row.name
        assert task.reward.sentence(), f"{name}: its reward has no formula in words"
        said = f"{name}: words for each entry, see tests/benchmarks/formula_texts.py"
        assert task_pages.num_observed(task) == task.physics.state_size, said


def test_functions_of_dm_controls_rewards_are_those_of_the_page():
    x, m, y = np.linspace(-3.0, 6.0, 91), 2.0, 0.5
    distance = np.maximum(1.0 - x, 0.0) + np.maximum(x - 2.0, 0.0)
    close = {"atol": 1e-6}
    np.testing.assert_allclose(
        tolerance(x, (1.0, 2.0), margin=m), 0.1 ** ((distance / m) ** 2), **close
    )
    np.testing.assert_array_equal(tolerance(x, (1.0, 2.0)), distance == 0)
    below = np.maximum(1.0 - x, 0.0)
    np.testing.assert_allclose(
        rising(x, 1.0, m, value_at_margin=y), np.maximum(0, 1 - (1 - y) * below / m), **close
    )
    np.testing.assert_allclose(small_control(x), np.maximum(0, 1 - x**2), **close)
    far = np.maximum(x - 2.0, 0.0)  # the swimmer's
    np.testing.assert_allclose(
        tolerance(x, (-9.0, 2.0), margin=m, sigmoid="long_tail"),
        1 / (1 + (3 * far / m) ** 2),
        **close,
    )


def test_a_text_is_filled_and_its_entries_are_counted():
    def observe(seen):
        """Return what is seen.

        * ``places`` as they are
        * ``2 * size`` more, {size / 4!.2f}
        """

    text = Text.of(observe, {"places": [("x", "m"), ("y", "m"), ("turn", "rad")], "size": 3})
    assert list(text.entries()) == [
        (3, "`x`, `y` (m), `turn` (rad), as they are"),
        (6, "more, 0.75"),
    ]
