"""Pages show what is kept in docs: writing their tables and figures anew changes nothing."""

from __future__ import annotations

import pytest

from tests.benchmarks import elsewhere, performance
from tests.benchmarks.figures import BENCHMARKS, PAGES, ROOT, page_of
from tests.benchmarks.pages import filled, names


@pytest.mark.parametrize(
    # The figures of pages about tasks take the physics of all of them.
    "name",
    [pytest.param(n, marks=pytest.mark.slow if n.startswith("docs/tasks") else ()) for n in PAGES],
)
def test_a_page_shows_what_is_kept(name):
    text = (ROOT / name).read_text("utf-8")
    assert names(text) == set(PAGES[name])
    assert filled(text, PAGES[name]) == text, "run: python -m tests.benchmarks.figures"


@pytest.mark.parametrize("machine", BENCHMARKS)
def test_the_page_of_a_whole_benchmark_shows_its_results(machine):
    page = (ROOT / f"docs/benchmarks/{machine}.md").read_text("utf-8")
    assert page == page_of(machine), "run: python -m tests.benchmarks.figures"


@pytest.mark.parametrize("name", elsewhere.CASES)
def test_what_a_policy_earns_elsewhere_is_of_the_policy_of_today(name):
    task, *_ = elsewhere.CASES[name]
    kept = performance.read("results/elsewhere.json")[name]
    assert kept["policy"] == elsewhere.identity(task)


def test_figures_stand_in_a_line_and_tables_apart():
    text = "It is <!-- a -->old<!-- end --> fast.\n\n<!-- b -->\n|old|\n<!-- end -->\n"
    wanted = "It is <!-- a -->9.1<!-- end --> fast.\n\n<!-- b -->\n|a|\n|b|\n<!-- end -->\n"
    assert filled(text, {"a": lambda: "9.1", "b": lambda: "|a|\n|b|"}) == wanted
    with pytest.raises(KeyError, match="b"):
        filled(text, {"a": lambda: "9.1"})
