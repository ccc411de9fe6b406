"""What was public under another name still works, and says what it is called now."""

from __future__ import annotations

import subprocess
import sys
import warnings
from importlib import import_module

import numpy as np
import pytest

import pixelbrax_gym  # noqa: F401, it makes former names known
from pixelbrax_jax import Clips, EnvState, PixelEnv, SimState
from pixelbrax_jax.deprecation import MOVED, RENAMED
from pixelbrax_jax.distractors import Color
from pixelbrax_jax.distractors.base import Distractor
from tests.envs.toy import Ball


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


FORMER_FIELDS = {
    "head_start": "time_limit_offset",
    "distraction": "distractor_state",
    "physics": "physics",
    "step_count": "step_count",
}


@pytest.mark.parametrize("name", FORMER_FIELDS)
def test_a_state_has_the_fields_of_its_simulation(name):
    sim = SimState(*map(object.__new__, [object] * 7))
    state = EnvState(sim, frames=None, key=None)
    with pytest.warns(
        DeprecationWarning, match=f"EnvState.{name} is EnvState.sim.{FORMER_FIELDS[name]}"
    ):
        assert getattr(state, name) is getattr(sim, FORMER_FIELDS[name])
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = state.nothing


def test_a_picture_is_an_image(monkeypatch):
    monkeypatch.setattr(PixelEnv, "image", lambda self, *args, **kwargs: (args, kwargs))
    env = PixelEnv(Ball(), height=4, width=4)
    with pytest.warns(DeprecationWarning, match="PixelEnv.picture is PixelEnv.image now"):
        assert env.picture("state", "params", height=3) == (("state", "params"), {"height": 3})


def test_a_distractor_may_still_begin():
    for base in (Distractor, Color):
        with pytest.warns(DeprecationWarning, match="Old.begin is called reset now"):

            class Old(base):
                def begin(self, key, params):
                    return key, params

        assert Old().reset(1, 2) == (1, 2)

    class New(Distractor):
        def reset(self, key, params):
            return params, key

    with pytest.warns(DeprecationWarning, match="Distractor.begin is Distractor.reset now"):
        assert New().begin(1, 2) == (2, 1)


def test_words_of_clips_are_packed_pixels():
    clips = Clips(packed=np.zeros((1, 2, 2), np.uint32), first=np.zeros(1), length=np.ones(1))
    with pytest.warns(DeprecationWarning, match="Clips.words is Clips.packed now"):
        assert clips.words is clips.packed


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
