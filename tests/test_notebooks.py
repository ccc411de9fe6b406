"""The notebooks run from top to bottom."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

FOLDER = Path(__file__).parents[1] / "docs" / "notebooks"
SMALL = {
    "pytorch": {"UPDATES = 128, 32, 60": "UPDATES = 8, 40, 2"},
    "jax-distractors": {
        "NUM_STEPS = 16, 1000": "NUM_STEPS = 2, 4",
        '    "paper-color": ("paper-color",),\n    "paper-video": ("paper-video",),\n': "",
    },
}
"""Notebook -> what a test changes of it to compute less."""


def code_cells(name: str) -> list[str]:
    notebook = json.loads((FOLDER / f"{name}.ipynb").read_text("utf-8"))
    return ["".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code"]


def run(name: str, replaced: dict[str, str]) -> dict:
    namespace = {"__name__": "__main__"}
    for number, code in enumerate(code_cells(name)):
        for old, new in replaced.items():
            code = code.replace(old, new)
        exec(compile(code, f"{name}, cell {number}", "exec"), namespace)
    plt.close("all")
    return namespace


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow if n == "jax-distractors" else ()) for n in SMALL],
)
def test_a_notebook_runs(name):
    source = "\n".join(code_cells(name))
    assert all(old in source for old in SMALL[name])
    found = run(name, SMALL[name])
    figures = found["bins"] if name == "pytorch" else [*map(jnp.mean, found["returns"].values())]
    assert np.isfinite(figures).all()
    assert len(figures) > 1


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_pytorch_notebook_learns():
    bins = run("pytorch", {})["bins"]
    assert bins[-1] > 5 * bins[0]


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_distractors_lower_the_return():
    returns = run("jax-distractors", {})["returns"]
    clean = float(returns["clean"].mean())
    assert clean > 3000
    assert all(float(returns[name].mean()) < clean for name in returns if name != "clean")


@pytest.mark.parametrize("name", SMALL)
def test_without_an_extra_a_notebook_says_how_to_get_it(name, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda package: None)
    with pytest.raises(ImportError, match=re.escape('pip install "pixelbrax[demo]"')):
        exec(code_cells(name)[0], {})


def test_every_notebook_is_run():
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == set(SMALL)
