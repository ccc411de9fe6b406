"""Pairs have the episodes of the evaluation, and of an uninterrupted recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_gym import evaluate_suite, record_pairs
from pixelbrax_gym.cli import dataset, main
from pixelbrax_gym.gymnasium.vector_env import GymnasiumVectorEnv
from pixelbrax_jax.generalisation import suites
from pixelbrax_jax.generalisation.changes import BodyColor
from tests.examples.test_examples import load
from tests.generalisation.conftest import TASK, TINY
from tests.generalisation.test_evaluate_suite import agent, of_jax, of_numpy

minari = pytest.importorskip("minari")


def record(folder, policy=of_numpy, level="turned", **more):
    path = record_pairs(policy, TASK, "tiny", level, folder, **{"num_envs": 2} | TINY | more)
    return list(minari.MinariDataset(path).iterate_episodes())


def same(one, other):
    assert list(one.observations) == list(other.observations)
    for name, found in one.observations.items():
        np.testing.assert_array_equal(found, other.observations[name])
    for name in ("actions", "rewards", "terminations", "truncations"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize(("sees", "level"), [("clean", "clean"), ("level", "turned")])
def test_returns_are_those_of_the_evaluation(sees, level, tmp_path):
    expected = evaluate_suite(of_numpy, TASK, "tiny", **TINY).returns["policy"][level]
    episodes = record(tmp_path, sees=sees)
    np.testing.assert_allclose([x.rewards.sum() for x in episodes], expected, rtol=1e-5)


def test_both_views_of_each_episode_are_stored_without_loss(tmp_path):
    images = ("depth", "segmentation")
    episodes = record(tmp_path, images=images)
    assert [episode.id for episode in episodes] == [0, 1, 2]
    shapes = {
        "pixels": ((6, 18, 18, 3), np.uint8),
        "pixels_level": ((6, 18, 18, 3), np.uint8),
        "depth": ((6, 18, 18, 1), np.float32),
        "segmentation": ((6, 18, 18, 1), np.int32),
        "state": ((6, 2), np.float32),
    }
    for episode in episodes:
        assert {n: (x.shape, x.dtype) for n, x in episode.observations.items()} == shapes
        assert episode.actions.shape == (5, 1)
        assert episode.truncations.tolist() == [False] * 4 + [True]
        seen = episode.observations
        # The camera is upside down; the ball is left of the middle in one view, right in the other.
        ball = seen["segmentation"] >= 0
        assert (np.isfinite(seen["depth"]) & (seen["depth"] > 0)).all()
        assert (seen["pixels"] != seen["pixels_level"]).any((1, 2, 3)).all()
        assert (np.ptp(seen["pixels"].astype(int), axis=(1, 2)) > 0).any()
        assert ball.any((1, 2, 3)).all()
    # The policy's actions follow from the clean frames.
    first = np.concatenate([episodes[0].observations["pixels"][0]] * 2, axis=-1)
    np.testing.assert_array_equal(episodes[0].actions[:1], of_numpy(first[None]))
    clean = record(tmp_path / "clean", level="clean", images=images)
    for one, other in zip(episodes, clean, strict=True):
        for name in ("pixels", "state"):
            np.testing.assert_array_equal(one.observations[name], other.observations[name])
        np.testing.assert_array_equal(one.rewards, other.rewards)
        # Programs of other images round differently.
        views = [other.observations[name].astype(int) for name in ("pixels", "pixels_level")]
        np.testing.assert_allclose(*views, atol=1)


@pytest.mark.parametrize("policy", [of_numpy, None])
@pytest.mark.parametrize("relative", [False, True])
def test_a_stopped_recording_continues(policy, relative, tmp_path, monkeypatch):
    if relative:
        monkeypatch.chdir(tmp_path)
        tmp_path = Path("pairs")
    whole = record(tmp_path / "whole", policy)
    told = []

    def stop(line):
        told.append(line)
        if line.startswith("2 of"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(tmp_path / "cut", policy, report=stop)
    # The last episode was being written.
    (tmp_path / "cut" / "2").mkdir()
    (tmp_path / "cut" / "2" / "part-0.parquet").write_bytes(b"PAR1 and no more")
    (tmp_path / "cut" / "2" / "metadata.json").write_text('{"id": ')
    (tmp_path / "cut" / "metadata.json").write_text('{"total_')
    for one, other in zip(record(tmp_path / "cut", policy, report=told.append), whole, strict=True):
        same(one, other)
    assert told == [
        "3 episodes, at most 0.00 GB before compression",
        "2 of 3 episodes",
        "1 episodes, at most 0.00 GB before compression",
        "3 of 3 episodes",
    ]
    # A finished one stays as it is.
    before = (tmp_path / "cut" / "0" / "part-0.parquet").stat().st_mtime_ns
    assert len(record(tmp_path / "cut", policy)) == 3
    assert (tmp_path / "cut" / "0" / "part-0.parquet").stat().st_mtime_ns == before


def test_a_recording_that_was_stopped_before_its_first_episode(tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(
            "minari.dataset.minari_storage.MinariStorage.update_metadata", _raise_interrupt
        )
        with pytest.raises(KeyboardInterrupt):
            record(tmp_path / "cut")
    for one, other in zip(record(tmp_path / "cut"), record(tmp_path / "whole"), strict=True):
        same(one, other)


def _raise_interrupt(*_):
    raise KeyboardInterrupt


def test_a_run_that_was_trained_again_is_another_recording(tmp_path, monkeypatch, capsys):
    line = ["dataset", "run", "--suite", "tiny", "--level", "painted", "--num-envs", "3"]
    line += ["--output-dir", str(tmp_path / "pairs")]
    for value, status in ((0.0, 0), (0.0, 0), (1.0, 1)):
        trained = replace(agent(), networks={"actor": np.full(3, value)})
        monkeypatch.setattr(dataset, "load", lambda *_, trained=trained: trained)
        assert main(line) == status
    assert "another recording: policy='run, seed 0" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_records_agents_and_random_actions(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(dataset, "load", lambda options, folder: agent())
    where = ["--suite", "tiny", "--level", "painted", "--num-envs", "3"]
    assert main(["dataset", "run", *where, "--output-dir", str(tmp_path / "run")]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "run")
    found = minari.MinariDataset(tmp_path / "run")
    assert found.storage.metadata["algorithm_name"] == "run, seed 0, 16 steps, e3b0c442"
    for one, other in zip(
        found.iterate_episodes(), record(tmp_path / "own", level="painted"), strict=True
    ):
        same(one, other)
    size = ["--height", "8", "--width", "9", "--episodes", "2", "--images", "depth"]
    random = ["--task", "inverted_pendulum", "--output-dir", str(tmp_path / "random")]
    monkeypatch.setattr("pixelbrax_gym.generalisation.pairs.EPISODES", 5)
    assert main(["dataset", *random, *where, *size]) == 0
    (one, other) = minari.MinariDataset(tmp_path / "random").iterate_episodes()
    assert one.observations["depth"].shape[1:] == (8, 9, 1)
    assert len(np.unique(one.actions)) == len(one.actions)
    assert set(one.actions[:2, 0]) != set(other.actions[:2, 0])


def test_the_example_reads_the_state_of_clean_images_alone(tmp_path, monkeypatch, capsys):
    more = suites.Suite(lambda _: (suites.Level("painted-0.5", (BodyColor(0.5),)),), 40, "tests")
    monkeypatch.setitem(suites.SUITES, "tiny", more)
    record(tmp_path, None, level="painted-0.5", num_envs=40, episode_length=20)
    # Minari refuses a name with a dot.
    assert minari.MinariDataset(tmp_path).spec.dataset_id.endswith("-tiny-painted-0-5-v0")
    probe = load("linear_probe").main([str(tmp_path), "--cells", "18", "--ridge", "0.01"])
    clean, level = probe["pixels"], probe["pixels_level"]
    assert clean[0] > 0.9, "the position of the ball"
    assert level[0] < clean[0]
    assert f"{clean.mean():6.2f}" in capsys.readouterr().out.splitlines()[-1]


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"level": "turnt"}, ValueError, "unknown level: 'turnt'.*Did you mean 'turned'"),
        ({"sees": "both"}, ValueError, "unknown sees: 'both'; allowed: clean, level"),
        ({"images": "normals"}, ValueError, "unknown images: 'normals'; allowed: depth, seg"),
        ({"obs_mode": "depth"}, TypeError, "obs_mode is decided by the recording; leave it out"),
        ({"policy": 3}, TypeError, "policy must be a function of observations or None, got 3"),
        (
            {"policy": lambda obs: jnp.full((2, 1), jnp.nan), "output": "jax"},
            ValueError,
            "actions of episodes 0, 1 contain NaN",
        ),
        ({"num_envs": 0}, ValueError, "num_envs must be a positive integer, got 0"),
        (
            {"policy": lambda obs: np.zeros((2, 3))},
            ValueError,
            r"actions of shape \(2, 1\), a row for each of 2 episodes, got \(2, 3\)",
        ),
    ],
)
def test_errors_say_what_is_allowed(options, error, message, tmp_path):
    with pytest.raises(error, match=message):
        record(tmp_path, **options)


def test_episodes_with_nan_are_named(tmp_path):
    # An episode has five steps, and the second batch has episode 2 alone.
    with pytest.raises(ValueError, match="actions of episodes 2 contain NaN"):
        record(tmp_path, _nan_in_call(6), output="jax")


def _nan_in_call(number):
    calls = iter(range(number + 1))
    return lambda obs: jnp.full((2, 1), jnp.nan if next(calls) == number - 1 else 0.0)


def test_clips_are_only_for_levels_with_video(tmp_path):
    options = {"suite": "paper", "output_dir": tmp_path, **TINY}
    with pytest.raises(FileNotFoundError, match="level 'video' of suite 'paper' shows videos"):
        record_pairs(None, TASK, level="video", **options)
    with pytest.raises(ValueError, match="level 'color' of suite 'paper' shows no video; leave"):
        record_pairs(None, TASK, level="color", clips="procedural", **options)


def test_a_folder_holds_one_recording(tmp_path):
    record(tmp_path / "one", of_jax, output="jax", episodes=1)
    with pytest.raises(ValueError, match=r"another recording: sees='clean', not 'level'\. Take"):
        record(tmp_path / "one", of_jax, output="jax", episodes=1, sees="level")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "metadata.json").write_text('{"name": "my package"}')
    with pytest.raises(ValueError, match="other has another recording"):
        record(tmp_path / "other")
    assert (tmp_path / "other" / "metadata.json").read_text() == '{"name": "my package"}'
    for mine, told in (
        ('{"total_episodes": 0}', "another recording"),
        ("[]", "not of a recording"),
    ):
        (tmp_path / "other" / "metadata.json").write_text(mine)
        with pytest.raises(ValueError, match=told):
            record(tmp_path / "other")
        assert (tmp_path / "other" / "metadata.json").read_text() == mine
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="full has files, but no recording"):
        record(tmp_path / "full")
    (tmp_path / "one" / "metadata.json").write_text('{"total_')
    # The copy of the last batch continues; without it nobody knows what the folder has.
    assert len(record(tmp_path / "one", of_jax, output="jax", episodes=1)) == 1
    (tmp_path / "one" / "metadata.json").write_text('{"total_')
    (tmp_path / "one" / "metadata.kept").unlink()
    with pytest.raises(ValueError, match=r"metadata\.json is damaged .*; delete the folder"):
        record(tmp_path / "one", of_jax, output="jax", episodes=1)


def test_torch_policies_may_need_a_gradient_or_have_low_precision(tmp_path):
    torch = pytest.importorskip("torch")
    weight = torch.ones(1, requires_grad=True)

    def policy(obs):
        action = torch.as_tensor(of_numpy(obs.numpy())) * 5.0
        return (action * weight).to(torch.bfloat16)

    for episode in record(tmp_path, policy, output="torch", episodes=1):
        assert episode.actions.dtype == np.float32
        assert np.abs(episode.actions).max() == 1.0, "as played"


def test_another_simulation_under_the_level_is_told(tmp_path, monkeypatch):
    step = GymnasiumVectorEnv.step

    def drifting(envs, actions):
        found = step(envs, actions)
        clean = isinstance(found[0], dict)
        return found if clean else (found[0], found[1] + 0.1, *found[2:])

    monkeypatch.setattr(GymnasiumVectorEnv, "step", drifting)
    with pytest.raises(RuntimeError, match="the episodes part in step 0 of episodes 0 to 1"):
        record(tmp_path)


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--height", "9"], "who acts? Give the folder of a run, --pretrained with a name"),
        (["run", "--task", "ant"], "--task is for random actions; leave out the agent"),
        (["--task", "ant", "--best"], "--task is for random actions; leave out the agent"),
        (["run", "--width", "9"], "--width is only for --task; an agent has its own size"),
    ],
)
def test_the_command_tells_who_may_act(more, told, tmp_path, capsys):
    where = ["--suite", "tiny", "--level", "painted", "--output-dir", str(tmp_path)]
    assert main(["dataset", *more, *where]) == 2
    assert told in capsys.readouterr().err
