"""What an option names is made at once, or the message says what stands in its place."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from pixelbrax_gym import cli, evaluate_suite
from pixelbrax_jax.agents.runner.checkpoint import CheckpointError
from pixelbrax_jax.agents.runner.settings import RunConfig
from pixelbrax_jax.agents.runner.trained import load_trained
from pixelbrax_jax.paths import make_file, make_folder
from pixelbrax_jax.video import write_frames


@pytest.fixture
def notes(tmp_path):
    """A file where a folder is wanted."""
    file = tmp_path / "notes"
    file.write_text("mine")
    return file


def test_folders_and_files_in_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    assert make_folder("output_dir", "~/a/b") == tmp_path / "a" / "b"
    assert make_file("--output", "~/c/d.json") == tmp_path / "c" / "d.json"
    assert RunConfig(output_dir="~/runs").output_dir == str(tmp_path / "runs")
    with pytest.raises(CheckpointError, match=f"no checkpoint in {tmp_path / 'runs'}"):
        load_trained("~/runs")
    black = np.zeros((8, 8, 3), np.uint8)
    assert write_frames("~/videos/a.gif", [black], 30) == tmp_path / "videos" / "a.gif"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "c", "videos"]


def test_a_relative_folder_stays_relative(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert make_folder("output_dir", "a/b") == Path("a/b")
    assert (tmp_path / "a" / "b").is_dir()


def test_a_file_keeps_what_it_has(notes):
    assert make_file("--output", notes).read_text() == "mine"


@pytest.mark.parametrize("below", ["", "runs/a"])
def test_a_file_in_place_of_a_folder(notes, below):
    with pytest.raises(ValueError, match=f"output_dir needs the folder .*, but {notes} is a file"):
        make_folder("output_dir", notes / below)
    with pytest.raises(ValueError, match=f"output_dir needs the folder .*, but {notes} is a file"):
        evaluate_suite(
            lambda obs: obs,
            "inverted_pendulum",
            "axes",
            output_dir=notes / below,
            clips="procedural",
            height=18,
            width=18,
        )
    assert notes.read_text() == "mine"


def test_a_link_to_nothing_is_named(tmp_path):
    (tmp_path / "gone").symlink_to(tmp_path / "none")
    with pytest.raises(ValueError, match=r"output_dir needs the folder .*gone is a link to what"):
        make_folder("output_dir", tmp_path / "gone")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
def test_a_pipe_without_a_reader_does_not_block(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    assert make_file("--output", tmp_path / "pipe") == tmp_path / "pipe"


def test_the_benchmark_refuses_a_folder_before_it_measures(tmp_path, capsys):
    assert cli.main(["bench", "--output", str(tmp_path)]) == 1
    assert f"--output must be a file, but {tmp_path} is a folder" in capsys.readouterr().err
