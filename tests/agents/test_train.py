"""Runs: what is logged, stopped, stored, and gone on with."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import PixelEnv
from pixelbrax_jax.agents.config import describe
from pixelbrax_jax.agents.on_policy.ppg import PPG, PPGConfig
from pixelbrax_jax.agents.runner import train
from pixelbrax_jax.agents.runner.checkpoint import (
    CheckpointError,
    Checkpoints,
    best_steps,
    read_about,
    read_networks,
)
from pixelbrax_jax.agents.runner.metrics import read_metrics, summarize
from pixelbrax_jax.agents.runner.saving import Saver
from pixelbrax_jax.agents.runner.train import RunConfig, TrainingDivergedError, run
from pixelbrax_jax.agents.runner.trained import save_policy
from pixelbrax_jax.policy import load_policy
from tests.agents.small import OPTIONS, PARAMS, SMALL, ball_envs, same, with_iterate
from tests.envs.toy import Ball

PHASES = {"num_policy_phases": 3, "aux_minibatches": 3, "aux_epochs": 1}
PER_ITERATION = SMALL["num_envs"] * SMALL["num_steps"]
SPLITS = {"clean": (PixelEnv(Ball(), **OPTIONS), PARAMS)}


def ppg(iterations: int, **changes):
    """PPG for some iterations, of which every third is followed by an auxiliary phase."""
    # Annealed, the step size would depend on the length of the run.
    settings = SMALL | PHASES | {"anneal": False} | changes
    settings["total_steps"] = iterations * PER_ITERATION
    return PPG(PPGConfig(**settings), ball_envs())


def options(folder, **changes) -> RunConfig:
    return RunConfig(output_dir=str(folder), progress=False, **changes)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run of eight iterations that is never stopped, and its folder."""
    folder = tmp_path_factory.mktemp("whole")
    return run(ppg(8), PARAMS, options(folder)), folder


def without_clock(record):
    clock = ("seconds", "speed/steps_per_second")
    return {name: value for name, value in record.items() if name not in clock}


@pytest.mark.parametrize("stopped_after", [5, 6])  # Within the buffer, and behind a phase.
def test_a_resumed_run_is_the_same_to_the_bit(whole, tmp_path, stopped_after):
    outcome, folder = whole
    run(ppg(stopped_after), PARAMS, options(tmp_path))
    lines = []
    resumed = run(ppg(8), PARAMS, options(tmp_path, resume="latest"), report=lines.append)
    assert any(f"checkpoint of {stopped_after * PER_ITERATION} steps" in line for line in lines)
    assert same(resumed.state, outcome.state)
    ours, theirs = (read_metrics(path / "metrics.jsonl") for path in (tmp_path, folder))
    assert [r["steps"] for r in ours] == [PER_ITERATION * i for i in range(1, 9)]
    assert [without_clock(r) for r in ours] == [without_clock(r) for r in theirs]
    seconds = [r["seconds"] for r in ours]
    assert seconds == sorted(seconds)


def test_nothing_around_the_training_changes_it(whole, tmp_path):
    outcome, _ = whole
    noisy = options(tmp_path, log_every=3, checkpoint_every=2 * PER_ITERATION)
    assert same(run(ppg(8), PARAMS, noisy).state, outcome.state)
    names = sorted(int(p.name) for p in (tmp_path / "checkpoints").iterdir() if p.name.isdigit())
    assert names[-1] == 8 * PER_ITERATION
    assert len(names) <= 4, "three latest and the best"
    records = read_metrics(tmp_path / "metrics.jsonl")
    assert sum(r["episode/count"] for r in records) == sum(
        r["episode/count"] for r in read_metrics(whole[1] / "metrics.jsonl")
    )


def test_without_metrics_and_evaluations_nothing_is_logged(tmp_path, monkeypatch):
    monkeypatch.setattr(train, "make_splits", None)
    outcome = run(ppg(3), PARAMS, options(tmp_path, log_training_metrics=False))
    assert read_metrics(tmp_path / "metrics.jsonl") == []
    assert outcome.metrics
    assert not outcome.evaluations


def test_metrics_are_finite_numbers_and_settings_lie_beside_them(whole):
    for record in read_metrics(whole[1] / "metrics.jsonl"):
        assert all(np.isfinite(value) for value in record.values()), record
    assert {"loss/policy", "loss/value", "learning_rate", "speed/steps_per_second"} <= set(record)
    assert (whole[1] / "tensorboard").is_dir()
    settings = json.loads((whole[1] / "config.json").read_text())
    assert settings == describe(ppg(8).config) | {"algorithm": "ppg", "seed": 0, "seeds": 1}


def test_an_earlier_run_is_not_overwritten(whole):
    before = (whole[1] / "config.json").read_bytes()
    with pytest.raises(FileExistsError, match="--resume latest"):
        run(ppg(8), PARAMS, options(whole[1]))
    with pytest.raises(CheckpointError, match="total_steps=160 are fewer than the 256 that the"):
        run(ppg(5), PARAMS, options(whole[1], resume="latest"))
    assert (whole[1] / "config.json").read_bytes() == before


def test_another_configuration_is_refused_by_name(whole):
    with pytest.raises(CheckpointError, match=r"gamma: 0.99 there, 0.5 here"):
        run(ppg(8, gamma=0.5), PARAMS, options(whole[1], resume="latest"))
    with pytest.raises(CheckpointError, match="seed: 0 there, 1 here"):
        run(ppg(8), PARAMS, options(whole[1], resume="latest", seed=1))
    about = next((whole[1] / "checkpoints").glob("*/about/metadata"))
    text = about.read_text()
    about.write_text(json.dumps(json.loads(text) | {"format": 0}))
    with pytest.raises(CheckpointError, match="format 0"):
        run(ppg(9), PARAMS, options(whole[1], resume="latest"))
    # Of the format before, the networks can still be read.
    about.write_text(json.dumps(json.loads(text) | {"format": 2}))
    with pytest.raises(CheckpointError, match="reads the networks alone: evaluate or record"):
        run(ppg(9), PARAMS, options(whole[1], resume="latest"))
    steps = int(about.parents[1].name)
    networks = read_networks(whole[1] / "checkpoints", whole[0].state.networks, steps)
    assert jax.tree.structure(networks) == jax.tree.structure(whole[0].state.networks)
    about.write_text(text)


def test_parameters_alone_are_read_with_other_settings(whole):
    outcome, folder = whole
    template = jax.eval_shape(lambda: outcome.state.networks)
    assert same(read_networks(folder / "checkpoints", template), outcome.state.networks)
    wrong = {"actor": jax.tree.map(lambda x: jnp.zeros((*x.shape, 1)), template["actor"])}
    with pytest.raises(CheckpointError, match=r"networks\.actor"):
        read_networks(folder / "checkpoints", wrong)


def test_a_half_written_checkpoint_is_not_seen(whole, tmp_path):
    outcome, _ = whole
    algorithm = ppg(8)
    checkpoints = Checkpoints(tmp_path, describe(algorithm.config), "ppg")
    checkpoints.save(outcome.state, 32, 1.0)
    checkpoints.close()
    half = tmp_path / "64.orbax-checkpoint-tmp-0"
    half.mkdir()
    (half / "state").write_bytes(b"cut off")
    again = Checkpoints(tmp_path, describe(algorithm.config), "ppg")
    assert again.steps() == [32]
    assert same(again.restore(outcome.state), outcome.state)
    again.close()


def test_the_best_and_the_latest_are_kept(tmp_path):
    state = {"x": jnp.arange(3), "key": jax.random.key(1), "none": jnp.zeros((0, 2))}
    checkpoints = Checkpoints(tmp_path, {}, "ppg", keep=2)
    for steps, score in ((1, None), (2, 9.0), (3, 1.0), (2**33, 2.0), (2**33 + 5, None)):
        checkpoints.save(
            state | {"x": jnp.arange(3) + score if score else state["x"]}, steps, score
        )
    checkpoints.wait()
    assert checkpoints.steps() == [2, 2**33, 2**33 + 5]
    assert best_steps(tmp_path) == 2
    with pytest.raises(CheckpointError, match="there are those of 2, 8589934592, 8589934597"):
        read_about(tmp_path, 3)
    assert same(checkpoints.restore(state), state)
    checkpoints.close()


def test_the_best_outlives_a_resumed_run(tmp_path):
    state = {"x": jnp.arange(3)}
    for scores in ((9.0, 1.0), (2.0, 3.0)):
        checkpoints = Checkpoints(tmp_path, {}, "ppg", keep=1)
        first = max(checkpoints.steps(), default=0) + 1
        for steps, score in enumerate(scores, first):
            checkpoints.save(state, steps, score)
        checkpoints.close()
    assert best_steps(tmp_path) == 1
    again = Checkpoints(tmp_path, {}, "ppg", keep=1)
    assert again.steps() == [1, 4]
    again.close()


def test_only_evaluations_score_where_there_are_any(tmp_path):
    each = options(tmp_path, num_evals=2, eval_episodes=1, checkpoint_every=PER_ITERATION)
    run(ppg(4), PARAMS, replace(each, keep_checkpoints=9), splits=SPLITS)
    scores = [read_about(tmp_path / "checkpoints", PER_ITERATION * i)["score"] for i in range(1, 5)]
    assert [score is not None for score in scores] == [False, True, False, True]
    evaluations = [r for r in read_metrics(tmp_path / "metrics.jsonl") if "eval/clean/return" in r]
    assert [r["eval/clean/return"] for r in evaluations] == [scores[1], scores[3]]
    # Of one episode there is no standard error, and NaN is not JSON.
    assert "NaN" not in (tmp_path / "metrics.jsonl").read_text()


@pytest.mark.parametrize("stopped", [False, True])
def test_what_follows_an_iteration(tmp_path, monkeypatch, stopped):
    done = []

    def watch(kind, name, place):
        method = getattr(kind, name)

        def call(self, *arguments, **others):
            done.append((name, arguments[place] // PER_ITERATION))
            return method(self, *arguments, **others)

        monkeypatch.setattr(kind, name, call)

    watch(train._Run, "log", 0)
    watch(train._Run, "evaluate", 1)
    watch(Saver, "save", 1)
    if stopped:
        signals = iter((0, 0, signal.SIGTERM))
        monkeypatch.setattr(train, "highest", lambda *_: (next(signals), 0))
    run(ppg(4), PARAMS, options(tmp_path, log_every=3, num_evals=2, eval_episodes=1), splits=SPLITS)
    if stopped:
        # Whoever is asked to stop may soon be killed: first what must not be lost.
        assert done == [("log", 2), ("save", 2), ("evaluate", 2)]
    else:
        every = ("log", "evaluate", "save")
        assert done == [*((name, 2) for name in every), ("log", 3), *((name, 4) for name in every)]


def test_a_run_under_other_versions_is_told(tmp_path):
    run(ppg(3), PARAMS, options(tmp_path))
    about = next((tmp_path / "checkpoints").glob("*/about/metadata"))
    about.write_text(about.read_text().replace(f'"jax": "{jax.__version__}"', '"jax": "0.0.1"'))
    lines = []
    run(ppg(4), PARAMS, options(tmp_path, resume="latest"), report=lines.append)
    assert any(f"jax 0.0.1 there, {jax.__version__} here" in line for line in lines)


def test_losses_that_are_not_finite_stop_the_run(tmp_path):
    algorithm = ppg(8)

    def iterate(state, params):
        state, metrics = algorithm.iterate(state, params)
        bad = jnp.where(state.iteration > 4, jnp.nan, 0.0)
        return state, metrics | {"loss/value": metrics["loss/value"] + bad}

    broken = with_iterate(algorithm, iterate)
    with pytest.raises(TrainingDivergedError, match=rf"loss/value.*{4 * PER_ITERATION} steps is"):
        run(broken, PARAMS, options(tmp_path, checkpoint_every=PER_ITERATION))
    names = [int(p.name) for p in (tmp_path / "checkpoints").iterdir() if p.name.isdigit()]
    assert max(names) == 4 * PER_ITERATION


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGUSR1])
def test_a_signal_writes_a_checkpoint_and_the_run_goes_on(whole, tmp_path, number):
    outcome, _ = whole
    algorithm = ppg(8)
    seen = []

    def iterate(state, params):
        state, metrics = algorithm.iterate(state, params)
        jax.debug.callback(lambda n: seen.append(n) or (n == 5 and interrupt()), state.iteration)
        return state, metrics

    def interrupt():
        signal.pthread_kill(threading.main_thread().ident, number)

    lines = []
    begun = options(tmp_path, resume="latest")
    stopped = run(with_iterate(algorithm, iterate), PARAMS, begun, report=lines.append)
    assert stopped.interrupted
    assert stopped.signal == number
    assert any(f"stopped by {number.name} after" in line for line in lines)
    assert any("a new run begins" in line for line in lines)
    assert any("stopping within two iterations" in line for line in lines)
    assert int(stopped.state.iteration) < 8
    resumed = run(ppg(8), PARAMS, options(tmp_path, resume="latest"))
    assert not resumed.interrupted
    assert same(resumed.state, outcome.state)


def test_training_stays_one_iteration_ahead_of_the_device(tmp_path, monkeypatch):
    """Were it further ahead, Ctrl-C would wait for all that has been asked for."""
    algorithm = ppg(12)

    def iterate(state, params):
        state, metrics = algorithm.iterate(state, params)
        heavy = jax.lax.fori_loop(0, 10, lambda _, x: x @ x / 800.0, jnp.ones((800, 800)))
        return state, metrics | {"heavy": heavy[0, 0]}

    one, ahead = train._Run.iterate, []

    def watched(self, state, number):
        state = one(self, state, number)
        ahead.append(sum(not record["heavy"].is_ready() for record in self.pending))
        return state

    monkeypatch.setattr(train._Run, "iterate", watched)
    run(with_iterate(algorithm, iterate), PARAMS, options(tmp_path, log_every=12))
    assert len(ahead) == 12
    assert max(ahead) == 1


def test_asked_to_stop_in_its_last_iteration_a_run_is_whole(whole, tmp_path):
    outcome, _ = whole
    algorithm = ppg(8)

    def iterate(state, params):
        state, metrics = algorithm.iterate(state, params)
        jax.debug.callback(lambda n: n == 8 and interrupt(), state.iteration)
        return state, metrics

    def interrupt():
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    lines = []
    late = with_iterate(algorithm, iterate)
    ended = run(late, PARAMS, options(tmp_path), report=lines.append)
    assert not ended.interrupted
    assert not any("--resume" in line for line in lines)
    assert same(ended.state, outcome.state)


def test_a_folder_that_cannot_be_written_to_is_told_early(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(CheckpointError, match="--output-dir"):
        run(ppg(8), PARAMS, options(tmp_path / "file" / "run"))


def test_a_full_disk_is_told_before_anything_is_written(whole, tmp_path, monkeypatch):
    usage = type("Usage", (), {"free": 10})()
    monkeypatch.setattr("shutil.disk_usage", lambda path: usage)
    checkpoints = Checkpoints(tmp_path, {}, "ppg")
    with pytest.raises(CheckpointError, match="free"):
        checkpoints.save(whole[0].state, 1, None)
    checkpoints.close()
    assert checkpoints.steps() == []


def test_a_buffer_that_would_not_fit_is_told_with_figures(tmp_path):
    lines = []
    with pytest.raises(MemoryError, match=r"Lower num_envs, num_steps, num_policy_phases"):
        run(ppg(8, memory_budget_gb=1e-6), PARAMS, options(tmp_path), report=lines.append)
    assert ", buffer " in lines[0]


def test_an_exported_policy_acts_without_the_package(whole, tmp_path):
    outcome, _ = whole
    algorithm = ppg(8)
    path = save_policy(algorithm, outcome.state.networks, tmp_path / "policy.jax")
    shape = algorithm.envs.env.obs_spec.shape
    pixels = np.random.default_rng(0).integers(0, 256, (5, *shape), np.uint8)
    expected = algorithm.act(outcome.state.networks, jnp.asarray(pixels))
    np.testing.assert_allclose(load_policy(path)(pixels), expected, rtol=1e-5, atol=1e-6)
    np.save(tmp_path / "pixels.npy", pixels)
    code = (
        "import sys, jax, numpy as np\n"
        f"pixels = np.load({str(tmp_path / 'pixels.npy')!r})\n"
        f"policy = jax.export.deserialize(bytearray(open({str(path)!r}, 'rb').read()))\n"
        "actions = policy.call(pixels)\n"
        "assert not any(name.startswith(('pixelbrax', 'flax')) for name in sys.modules)\n"
        f"np.save({str(tmp_path / 'actions.npy')!r}, actions)\n"
    )
    environ = os.environ | {"PYTHONPATH": ""}
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path, env=environ)
    np.testing.assert_allclose(np.load(tmp_path / "actions.npy"), expected, rtol=1e-5, atol=1e-6)


def test_a_policy_takes_and_gives_tensors(whole):
    torch = pytest.importorskip("torch", reason="not in the lanes of other releases")
    from pixelbrax_gym import TorchPolicy

    outcome, folder = whole
    algorithm = ppg(8)
    shape = algorithm.envs.env.obs_spec.shape
    pixels = np.random.default_rng(0).integers(0, 256, (5, *shape), np.uint8)
    policy = TorchPolicy(folder / "policy.jax")
    action = policy(torch.from_numpy(pixels))
    assert action.dtype == torch.float32
    expected = algorithm.act(outcome.state.networks, jnp.asarray(pixels))
    np.testing.assert_allclose(action.numpy(), expected, rtol=1e-5, atol=1e-6)
    # A view that is not contiguous is what it shows.
    turned = torch.from_numpy(pixels).flip(0)[::2]
    np.testing.assert_allclose(policy(turned).numpy(), expected[::-1][::2], rtol=1e-5, atol=1e-6)
    with pytest.raises(ValueError, match=r"uint8 pixels, got \(5, 18, 18, 6\) float32"):
        policy(torch.from_numpy(pixels).float())
    with pytest.raises(ValueError, match=r"takes \(B, 18, 18, 6\) uint8 pixels, got \(5, 18, 18\)"):
        policy(torch.from_numpy(pixels[..., 0]))


def test_no_policy_is_told(tmp_path):
    with pytest.raises(FileNotFoundError, match="no policy"):
        load_policy(tmp_path / "policy.jax")
    (tmp_path / "policy.jax").write_bytes(b"nonsense")
    with pytest.raises(ValueError, match="no exported policy"):
        load_policy(tmp_path / "policy.jax")


def test_episodes_count_equally_whichever_iteration_they_ended_in():
    records = [
        {"episode/count": 1, "episode/return_sum": 10.0, "episode/length_sum": 5, "x": 1.0},
        {
            "episode/count": 3,
            "episode/return_sum": 0.0,
            "episode/length_sum": 3,
            "x": 3.0,
            "y": 7.0,
        },
        {"episode/count": 0, "episode/return_sum": 0.0, "episode/length_sum": 0, "x": 5.0},
    ]
    summary = summarize(records)
    assert summary == {
        "episode/count": 4.0,
        "episode/return": 2.5,
        "episode/length": 2.0,
        "x": 3.0,
        "y": 7.0,
    }
    assert "episode/return" not in summarize(records[2:])


def test_seeds_of_one_program_are_those_of_their_own(whole, tmp_path):
    both = run(ppg(4), PARAMS, options(tmp_path / "both", seeds=2))
    alone = run(ppg(4), PARAMS, options(tmp_path / "alone", seed=1))
    second = jax.tree.map(lambda leaf: leaf[1], both.state.networks)
    for a, b in zip(jax.tree.leaves(second), jax.tree.leaves(alone.state.networks), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)
    assert (tmp_path / "both" / "policy_seed1.jax").exists()
