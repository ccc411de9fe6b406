"""What is missing is named, with an extra that exists and one way to install it."""

from __future__ import annotations

import importlib
import re
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from pixelbrax_gym import cli, doctor
from pixelbrax_gym.gymnasium import window
from pixelbrax_jax import load_clips
from pixelbrax_jax.distractors import media
from pixelbrax_jax.extras import install_extra
from pixelbrax_jax.video import write_frames

ROOT = Path(__file__).parents[1]
SOURCES = [*(ROOT / "pixelbrax_jax").rglob("*.py"), *(ROOT / "pixelbrax_gym").rglob("*.py")]


def test_the_command():
    assert install_extra("sb3") == 'pip install "pixelbrax[sb3]"'
    either = install_extra("cuda12", "cuda13")
    assert either == 'pip install "pixelbrax[cuda12]" or pip install "pixelbrax[cuda13]"'


def test_there_is_one_place_that_says_how():
    command = re.compile(r"pip install.*(\.|pixelbrax)\[")
    places = {path.name for path in SOURCES if command.search(path.read_text("utf-8"))}
    assert places == {"extras.py"}


def test_extras_that_are_named_exist():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    sources = "".join(path.read_text("utf-8") for path in SOURCES)
    calls = re.findall(r"(?:install|needs)_extra\(([^)]*)\)", sources)
    named = {name for call in calls for name in re.findall(r"""["'](\w+)["']""", call)}
    named |= set(doctor.EXTRAS)
    assert {"torch", "clips", "cuda13"} <= named
    assert named <= set(project["optional-dependencies"])


@pytest.mark.parametrize(
    ("absent", "adapter", "extra"),
    [
        ("torch", "pixelbrax_gym.interop.dlpack", "torch"),
        ("torchrl.envs", "pixelbrax_gym.torchrl.env", "torchrl"),
        ("stable_baselines3.common.vec_env", "pixelbrax_gym.sb3.vec_env", "sb3"),
    ],
)
def test_a_framework_that_is_missing(monkeypatch, absent, adapter, extra):
    monkeypatch.setitem(sys.modules, absent, None)
    monkeypatch.delitem(sys.modules, adapter, raising=False)
    with pytest.raises(ImportError, match=rf"is not installed; try: .*\[{extra}\]"):
        importlib.import_module(adapter)


def test_a_reader_that_is_missing(monkeypatch, tmp_path):
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "PIL", None)
        with pytest.raises(ImportError, match=r"images needs Pillow; try: .*\[clips\]"):
            media.pillow()
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    (tmp_path / "video.mp4").write_bytes(b"")
    with pytest.raises(ImportError, match=r"videos needs imageio-ffmpeg; try: .*\[clips\]"):
        load_clips(tmp_path, "all", cache_dir=tmp_path, progress=False)


def test_a_window_without_pygame(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ImportError, match=r"needs pygame; try: .*\[human\]"):
        window.Window("Ant", 20)


def test_a_video_needs_an_extra(monkeypatch, tmp_path):
    for absent, name in (("PIL", "a.gif"), ("imageio_ffmpeg", "a.mp4")):
        monkeypatch.setitem(sys.modules, absent, None)
        with pytest.raises(ImportError, match=r"needs imageio-ffmpeg and Pillow; try: .*\[video\]"):
            write_frames(tmp_path / name, [], 20)


def test_missing_packages_are_those_of_the_project(monkeypatch):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    lines = [
        f"{line}; extra == '{x}'"
        for x in ("train", "dataset")
        for line in project["optional-dependencies"][x]
    ]
    lines += ["jax>=0.10", "dm-control>=1; (python_version < '3.13') and extra == 'dmc'"]
    lines += ["later>=1; (python_version > '3.99') and extra == 'dmc'"]
    monkeypatch.setattr(metadata, "requires", lambda _: lines)
    monkeypatch.setattr(doctor, "installed_version", lambda _: None)
    names = [re.split(r"[^\w.-]", line)[0] for line in project["optional-dependencies"]["train"]]
    assert doctor.missing_packages("train") == names
    of_dmc = ["dm-control"] if sys.version_info < (3, 13) else []
    assert doctor.missing_packages("dmc") == of_dmc
    monkeypatch.setattr(doctor, "installed_version", lambda name: None if name == "psutil" else "1")
    assert doctor.missing_packages("train") == ["psutil"]
    assert doctor.missing_packages("dataset") == []


def test_training_does_not_begin_without_what_its_end_needs(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "flatbuffers", None)
    monkeypatch.delitem(sys.modules, "pixelbrax_jax.agents.runner.train", raising=False)
    assert cli.main(["train", "ppo", "--preset", "ci", "--total-steps", "0"]) == 1
    told = capsys.readouterr().err
    assert "flatbuffers" in told
    assert '"pixelbrax[train]"' in told


@pytest.mark.parametrize("command", ["train", "evaluate", "record"])
def test_trained_agents_need_an_extra(monkeypatch, capsys, command):
    for module in ("train", "trained"):
        monkeypatch.setitem(sys.modules, f"pixelbrax_jax.agents.runner.{module}", None)
    assert cli.main([command, "ppo"]) == 1
    assert '"pixelbrax[train]"' in capsys.readouterr().err
