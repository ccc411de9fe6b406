"""Policies that come with the package: files, figures, and what is wrong with others."""

from __future__ import annotations

import json
import re

import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_gym.cli import main
from pixelbrax_jax import list_pretrained, load_policy, make, policy
from pixelbrax_jax.agents.registry import ALGORITHMS
from pixelbrax_jax.agents.runner.trained import load_pretrained

SOURCES = re.compile(rb"[\w./-]+\.py\b")
"""Paths of source files, which tell of the machine."""


@pytest.mark.parametrize("name", list_pretrained())
def test_a_pretrained_policy_is_small_and_fits_its_environment(name):
    about = policy.read_pretrained(name)
    file = policy.FOLDER / f"{name}.jax"
    assert file.stat().st_size <= 2_000_000
    assert not SOURCES.search(file.read_bytes())
    acts = load_policy(name)
    env, _ = make(**acts.env_options)
    assert env.obs_spec.shape == acts.shape
    action = acts(jnp.zeros((3, *acts.shape), jnp.uint8))
    assert action.shape == (3, env.action_size)
    assert np.all(np.isfinite(action))
    agent = load_pretrained(name)
    assert agent.algorithm.config.env.task == name
    assert about["algorithm"] in ALGORITHMS
    assert agent.steps == about["steps"]


@pytest.mark.slow
@pytest.mark.parametrize("name", list_pretrained())
def test_a_pretrained_policy_earns_what_its_table_says(name, capsys):
    about = policy.read_pretrained(name)
    assert main(["evaluate", "--pretrained", name, "--episodes", str(about["episodes"])]) == 0
    line = json.loads(capsys.readouterr().out)
    # The same episodes; another processor rounds otherwise, and episodes part in time.
    errors = np.hypot(line["standard_error"], about["standard_error"])
    assert abs(line["return"] - about["return"]) < 4 * errors


@pytest.mark.parametrize("command", ["evaluate", "record"])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--pretrained", "cheetah"],
            "unknown pretrained policy: 'cheetah'. Did you mean 'halfcheetah'? Allowed: ",
        ),
        (["--pretrained", "halfcheetah", "--split", "test"], "its splits: 'clean'."),
    ],
)
def test_a_wrong_choice_is_told(command, arguments, message, capsys):
    assert main([command, *arguments]) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("command", ["evaluate", "record"])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give either the folder of a run or --pretrained"),
        (["runs/ppo", "--pretrained", "halfcheetah"], "give either the folder of a run or"),
        (["--pretrained", "halfcheetah", "--best"], "--steps, --best and --run need the folder"),
    ],
)
def test_a_wrong_command_line_is_told(command, arguments, message, capsys):
    assert main([command, *arguments]) == 2
    assert message in capsys.readouterr().err


def test_an_unknown_name_tells_which_there_are(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nor the name of .*policies: .*halfcheetah"):
        load_policy("cheetah")
    # A file is taken before a name.
    with pytest.raises(FileNotFoundError):
        load_policy(tmp_path / "halfcheetah")


def test_a_policy_of_another_jax_is_told(tmp_path, monkeypatch):
    (tmp_path / "ant.jax").write_bytes(b"of another time")
    about = {"versions": {"jax": "9.9.9"}, "env_options": {}}
    (tmp_path / "ant.json").write_text(json.dumps(about))
    monkeypatch.setattr(policy, "FOLDER", tmp_path)
    with pytest.raises(ValueError, match=r"(?s)exported policy.*was made with jax 9\.9\.9"):
        load_policy("ant")
