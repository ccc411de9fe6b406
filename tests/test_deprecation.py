"""What was public under another name still works, and says what it is called now."""

from __future__ import annotations

import subprocess
import sys
import warnings
from importlib import import_module

import pytest

import pixelbrax_gym  # noqa: F401, it makes former names known
from pixelbrax_jax.deprecation import MOVED, RENAMED


def former(name):
    """Import a module by a former name as if for the first time."""
    sys.modules.pop(name, None)
    with pytest.warns(DeprecationWarning, match=f"{name} is {MOVED[name]} now"):
        return import_module(name)


@pytest.mark.parametrize("name", MOVED)
def test_modules_are_found_under_former_names(name):
    module, now = former(name), import_module(MOVED[name])
    public = {key for key in vars(now) if not key.startswith("_")}
    assert public
    assert all(getattr(module, key) is getattr(now, key) for key in public)
    assert now.__name__ == MOVED[name]


@pytest.mark.parametrize("name", RENAMED)
def test_names_that_left_their_module_are_found(name):
    where, _, attribute = name.rpartition(".")
    there, _, renamed = RENAMED[name].rpartition(".")
    assert getattr(former(where), attribute) is getattr(import_module(there), renamed)


def test_other_names_are_not_found():
    with warnings.catch_warnings(), pytest.raises(ModuleNotFoundError, match="no_such_module"):
        import_module("pixelbrax_jax.no_such_module")


def test_a_former_name_is_found_first():
    code = "from pixelbrax_jax.agents.ppo import PPOConfig, make_train; print(PPOConfig.__module__)"
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False
    )
    assert "DeprecationWarning: pixelbrax_jax.agents.ppo is" in result.stderr
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "pixelbrax_jax.agents.algorithms.ppo"
