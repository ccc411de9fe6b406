"""Runs of earlier releases continue, and those of later ones are refused by name."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import jax
import pytest

from pixelbrax_jax.agents.on_policy.ppo import PPO, PPOConfig
from pixelbrax_jax.agents.runner import settings
from pixelbrax_jax.agents.runner.checkpoint import CheckpointError, Checkpoints, read_about
from pixelbrax_jax.agents.runner.programs import Runs
from pixelbrax_jax.agents.runner.settings import RunConfig
from pixelbrax_jax.agents.runner.train import run
from pixelbrax_jax.agents.runner.trained import load_config
from tests.agents.small import OPTIONS, PARAMS, SMALL, ball_envs, same

ARCHIVE = Path(__file__).with_name("run_0_2_0.zip")
"""The checkpoint of release 0.2.0 after the first of five iterations of PPO, with ``SMALL``."""


def ppo(**changes) -> PPO:
    return PPO(PPOConfig(**SMALL, layout="shared", **changes), ball_envs())


SINCE: dict[str, object] = {
    "engine": "auto",
    "num_starts": 0,
    "samples": 1,
    "camera_sizes": [],
    "dynamics": "",
    "test_dynamics": "",
}
"""Settings that release 0.2.0 lacks, and the values that it trained with."""


@pytest.fixture
def folder(tmp_path) -> Path:
    """The output folder of a run of 0.2.0."""
    with zipfile.ZipFile(ARCHIVE) as archive:
        archive.extractall(tmp_path / "checkpoints")
    return tmp_path


def change(folder: Path, *, without: tuple[str, ...] = (), **changes) -> None:
    """Change what is stored of a run's settings; other names are stored beside them."""
    path = folder / "checkpoints" / "32" / "about" / "metadata"
    about = json.loads(path.read_text())
    about["config"] = {n: v for n, v in about["config"].items() if n not in without}
    about["config"] |= changes.pop("config", {})
    path.write_text(json.dumps(about | changes))


def restore(folder: Path, algorithm: PPO, name: str = "ppo"):
    about = settings.describe_run(algorithm, RunConfig()) | {"algorithm": name}
    former = settings.former_settings(type(algorithm.config))
    checkpoints = Checkpoints(folder / "checkpoints", about, former=former)
    try:
        return checkpoints.restore(Runs(algorithm).template(PARAMS))
    finally:
        checkpoints.close()


def test_a_run_of_0_2_0_goes_on(folder):
    assert read_about(folder / "checkpoints")["versions"]["pixelbrax"] == "0.2.0"
    before = restore(folder, ppo())
    assert int(before.iteration) == 1
    # As in a new run, whose compiled programs are used again.
    assert not any(leaf.committed for leaf in jax.tree.leaves(before))
    lines = []
    options = RunConfig(str(folder), resume="latest", progress=False)
    outcome = run(ppo(), PARAMS, options, report=lines.append)
    assert "continuing from the checkpoint of 32 steps" in lines
    assert int(outcome.state.iteration) == 5
    assert not same(outcome.state.networks, before.networks)
    assert load_config(read_about(folder / "checkpoints")) == ppo().config


def test_keys_are_restored_whatever_jax_draws_numbers_with(folder):
    expected = restore(folder, ppo())
    with jax.default_prng_impl("rbg"):
        assert same(restore(folder, ppo()), expected)


def test_a_setting_that_a_run_lacks_has_the_default(folder):
    change(folder, without=("vf_coef", "clip_value"))
    restore(folder, ppo())
    with pytest.raises(CheckpointError, match=r"vf_coef: 0\.5 there, 0\.7 here"):
        restore(folder, ppo(vf_coef=0.7))
    assert load_config(read_about(folder / "checkpoints")) == ppo().config


def test_a_default_of_0_2_0_that_changes_is_kept_for_older_runs(folder):
    stored = read_about(folder / "checkpoints")["config"]
    former = settings.former_settings(PPOConfig)
    by_default = former.keys() - {*SMALL, *OPTIONS, "episode_length", "layout"}
    expected = {name: stored[name] for name in by_default & stored.keys()} | SINCE
    assert {name: former[name] for name in by_default} == expected


def test_a_setting_of_a_later_release_is_refused_by_name(folder):
    versions = read_about(folder / "checkpoints")["versions"] | {"pixelbrax": "9.1.0"}
    change(folder, config={"depth_of_thought": 3}, versions=versions)
    told = r"depth_of_thought=3: the run was written by pixelbrax 9\.1\.0"
    with pytest.raises(CheckpointError, match=r"depth_of_thought: 3 there, unknown here.*" + told):
        restore(folder, ppo())
    with pytest.raises(CheckpointError, match=told):
        load_config(read_about(folder / "checkpoints"))


def test_a_run_of_another_kind_is_refused(folder):
    with pytest.raises(CheckpointError, match="is a run of ppo, not of ppg"):
        restore(folder, ppo(), "ppg")
    change(folder, config={"layout": "separate"})
    other = PPO(PPOConfig(**SMALL), ball_envs())
    with pytest.raises(CheckpointError, match=r"other arrays: networks\.actor.* and \d+ more \("):
        restore(folder, other)
    change(folder, format=5)
    with pytest.raises(CheckpointError, match="has format 5, this version reads 4"):
        restore(folder, ppo())


def test_of_clips_the_content_decides_and_without_digests_the_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def other(there, here, digests_there=None, digests_here=None):
        about = {"config": {"clips": there}, "clips": digests_there}
        return settings.differences(about, {"config": {"clips": here}, "clips": digests_here})

    assert other("a", "b", ["1", "2"], ["1", "2"]) == []
    assert other("a", "a", ["1", "2"], ["2", "1"]) == [
        f"clips: those of '{tmp_path}/a' there, different ones in '{tmp_path}/a' here"
    ]
    assert other("a", str(tmp_path / "a"), None, ["1"]) == []
    assert other("a", "b", None, ["1"])[0].endswith(
        f"'{tmp_path}/b' here (the run has no digest of its clips, so the folder must be equal)"
    )
    assert other(None, "procedural") == []
    assert other("procedural", "a", None, ["1"]) == [
        f"clips: 'procedural' there, '{tmp_path}/a' here"
    ]
