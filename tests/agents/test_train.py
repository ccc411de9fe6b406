"""Runs: what is logged, stopped, stored, and gone on with."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial

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
    all_steps,
    best_steps,
    latest_steps,
    read_about,
    read_networks,
)
from pixelbrax_jax.agents.runner.metrics import read_metrics, summarize
from pixelbrax_jax.agents.runner.settings import RunConfig
from pixelbrax_jax.agents.runner.train import TrainingDivergedError, run
from pixelbrax_jax.policy import load_policy
from tests.agents.small import (
    ABOUT,
    OPTIONS,
    PARAMS,
    SMALL,
    assert_close,
    ball_envs,
    same,
    with_iterate,
)
from tests.envs.toy import Ball

PHASES = {"num_policy_phases": 3, "aux_minibatches": 3, "aux_epochs": 1}
PER_ITERATION = SMALL["num_envs"] * SMALL["num_steps"]
ITERATIONS = 8
SPLITS = {"clean": (PixelEnv(Ball(), **OPTIONS), PARAMS)}


def ppg(iterations: int = ITERATIONS, **changes):
    """PPG for some iterations, of which every third is followed by an auxiliary phase."""
    # Annealed, the step size would depend on the length of the run.
    settings = SMALL | PHASES | {"anneal": False} | changes
    settings["total_steps"] = iterations * PER_ITERATION
    return PPG(PPGConfig(**settings), ball_envs())


def options(folder, **changes) -> RunConfig:
    return RunConfig(output_dir=str(folder), progress=False, **changes)


def after(monkeypatch, number, action):
    """Have every run call ``action(run)`` behind its iteration of that number."""
    iterate = train._Run.iterate

    def watched(self, state, current):
        state = iterate(self, state, current)
        if current == number:
            action(self)
        return state

    monkeypatch.setattr(train._Run, "iterate", watched)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that is never stopped, and its folder."""
    folder = tmp_path_factory.mktemp("whole")
    return run(ppg(), PARAMS, options(folder)), folder


@pytest.fixture(autouse=True)
def _exports_no_policy(monkeypatch):
    """Runs but ``whole``, which is made before, as its scope is wider."""
    monkeypatch.setattr(train, "save_policy", lambda algorithm, networks, path: path.touch())


def without_clock(record):
    clock = ("seconds", "speed/steps_per_second")
    return {name: value for name, value in record.items() if name not in clock}


@pytest.mark.parametrize(
    "stopped_by",
    [
        pytest.param(None, marks=pytest.mark.slow),
        signal.SIGINT,
        pytest.param(signal.SIGUSR1, marks=pytest.mark.slow),
    ],
)
def test_a_resumed_run_is_the_same_to_the_bit(whole, tmp_path, monkeypatch, stopped_by):
    outcome, folder = whole
    lines = []
    resuming = options(tmp_path, resume="latest")
    if stopped_by is None:
        # Within the buffer; a run may be given more steps than it had.
        run(ppg(5), PARAMS, options(tmp_path))
    else:
        # Behind an auxiliary phase.
        with monkeypatch.context() as patch:
            after(patch, 6, lambda _: signal.raise_signal(stopped_by))
            stopped = run(ppg(), PARAMS, resuming, report=lines.append)
        assert stopped.signal == stopped_by
        assert int(stopped.state.iteration) == 6
        for told in ("starting a new run", "stopping within two iterations"):
            assert any(told in line for line in lines)
        assert any(f"stopped by {stopped_by.name} after" in line for line in lines)
    resumed = run(ppg(), PARAMS, resuming, report=lines.append)
    steps = PER_ITERATION * (5 if stopped_by is None else 6)
    assert f"continuing from the checkpoint of {steps} steps" in lines
    assert not resumed.signal
    assert same(resumed.state, outcome.state)
    ours, theirs = (read_metrics(path / "metrics.jsonl") for path in (tmp_path, folder))
    assert [r["steps"] for r in ours] == [PER_ITERATION * i for i in range(1, ITERATIONS + 1)]
    assert [without_clock(r) for r in ours] == [without_clock(r) for r in theirs]
    seconds = [r["seconds"] for r in ours]
    assert seconds == sorted(seconds)


def test_nothing_around_the_training_changes_it(whole, tmp_path):
    outcome, _ = whole
    noisy = options(tmp_path, log_every=3, checkpoint_every=2 * PER_ITERATION)
    assert same(run(ppg(), PARAMS, noisy).state, outcome.state)
    names = sorted(int(p.name) for p in (tmp_path / "checkpoints").iterdir() if p.name.isdigit())
    assert names[-1] == 8 * PER_ITERATION
    assert len(names) <= 4, "three latest and the best"
    records = read_metrics(tmp_path / "metrics.jsonl")
    assert sum(r["episode/count"] for r in records) == sum(
        r["episode/count"] for r in read_metrics(whole[1] / "metrics.jsonl")
    )


def test_without_metrics_and_evaluations_nothing_is_logged(tmp_path, monkeypatch):
    monkeypatch.setattr(train, "make_splits", None)
    outcome = run(ppg(), PARAMS, options(tmp_path, log_training_metrics=False))
    assert read_metrics(tmp_path / "metrics.jsonl") == []
    assert outcome.metrics
    assert not outcome.evaluations


def test_metrics_are_finite_numbers_and_settings_lie_beside_them(whole):
    for record in read_metrics(whole[1] / "metrics.jsonl"):
        assert all(np.isfinite(value) for value in record.values()), record
    assert {"loss/policy", "loss/value", "learning_rate", "speed/steps_per_second"} <= set(record)
    assert (whole[1] / "tensorboard").is_dir()
    settings = json.loads((whole[1] / "config.json").read_text())
    assert settings == describe(ppg().config) | {"algorithm": "ppg", "seed": 0, "seeds": 1}


def test_an_earlier_run_is_not_overwritten(whole):
    before = (whole[1] / "config.json").read_bytes()
    with pytest.raises(FileExistsError, match="--resume latest"):
        run(ppg(), PARAMS, options(whole[1]))
    with pytest.raises(CheckpointError, match="total_steps=160 must be at least 256"):
        run(ppg(5), PARAMS, options(whole[1], resume="latest"))
    assert (whole[1] / "config.json").read_bytes() == before


def test_another_configuration_is_refused_by_name(whole):
    with pytest.raises(CheckpointError, match=r"gamma: 0.99 there, 0.5 here"):
        run(ppg(gamma=0.5), PARAMS, options(whole[1], resume="latest"))
    with pytest.raises(CheckpointError, match="seed: 0 there, 1 here"):
        run(ppg(), PARAMS, options(whole[1], resume="latest", seed=1))
    about = next((whole[1] / "checkpoints").glob("*/about/metadata"))
    text = about.read_text()
    about.write_text(json.dumps(json.loads(text) | {"format": 0}))
    with pytest.raises(CheckpointError, match="format 0"):
        run(ppg(), PARAMS, options(whole[1], resume="latest"))
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
    checkpoints = Checkpoints(tmp_path, ABOUT)
    checkpoints.save(outcome.state, 32, 1.0)
    checkpoints.close()
    half = tmp_path / "64.orbax-checkpoint-tmp-0"
    half.mkdir()
    (half / "state").write_bytes(b"cut off")
    again = Checkpoints(tmp_path, ABOUT)
    assert all_steps(tmp_path) == [32]
    assert same(again.restore(outcome.state), outcome.state)
    again.close()


def test_the_best_and_the_latest_are_kept(tmp_path):
    state = {"x": jnp.arange(3), "key": jax.random.key(1), "none": jnp.zeros((0, 2))}
    checkpoints = Checkpoints(tmp_path, ABOUT, keep=2)
    for steps, score in ((1, None), (2, 9.0), (3, 1.0), (2**33, 2.0), (2**33 + 5, None)):
        checkpoints.save(
            state | {"x": jnp.arange(3) + score if score else state["x"]}, steps, score
        )
    checkpoints.look_after(wait=True)
    assert all_steps(tmp_path) == [2, 2**33, 2**33 + 5]
    assert best_steps(tmp_path) == 2
    with pytest.raises(CheckpointError, match="checkpoints have 2, 8589934592, 8589934597"):
        read_about(tmp_path, 3)
    assert same(checkpoints.restore(state), state)
    checkpoints.close()
    # The best outlives a resumed run.
    again = Checkpoints(tmp_path, ABOUT, keep=1)
    again.save(state, 2**34, 3.0, last=True)
    assert all_steps(tmp_path) == [2, 2**34]
    again.close()


def test_training_episodes_score_where_there_are_no_evaluations(tmp_path):
    """All that ended since the last checkpoint, in iterations with a record or without."""
    each = options(tmp_path, checkpoint_every=4 * PER_ITERATION)
    run(ppg(), PARAMS, replace(each, keep_checkpoints=9))
    records = read_metrics(tmp_path / "metrics.jsonl")
    for first, steps in ((0, 4 * PER_ITERATION), (4 * PER_ITERATION, 8 * PER_ITERATION)):
        part = [r for r in records if first < r["steps"] <= steps and r["episode/count"]]
        count = sum(r["episode/count"] for r in part)
        mean = sum(r["episode/return"] * r["episode/count"] for r in part) / count
        score = read_about(tmp_path / "checkpoints", steps)["score"]
        assert score == pytest.approx(mean)
        assert len(part) > 1


def test_splits_need_one_without_distractors(tmp_path):
    with pytest.raises(ValueError, match="splits must have 'clean', got test"):
        run(ppg(), PARAMS, options(tmp_path, num_evals=1), splits={"test": SPLITS["clean"]})


@pytest.mark.slow
def test_only_evaluations_score_where_there_are_any(tmp_path):
    each = options(tmp_path, num_evals=2, eval_episodes=1, checkpoint_every=PER_ITERATION)
    run(ppg(), PARAMS, replace(each, keep_checkpoints=9), splits=SPLITS)
    steps = [PER_ITERATION * i for i in range(1, ITERATIONS + 1)]
    scores = {n: read_about(tmp_path / "checkpoints", n)["score"] for n in steps}
    scores = {n: score for n, score in scores.items() if score is not None}
    assert list(scores) == [4 * PER_ITERATION, 8 * PER_ITERATION]
    evaluations = [r for r in read_metrics(tmp_path / "metrics.jsonl") if "eval/clean/return" in r]
    assert [r["eval/clean/return"] for r in evaluations] == list(scores.values())
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
    watch(Checkpoints, "save", 1)
    if stopped:
        after(monkeypatch, 4, lambda _: signal.raise_signal(signal.SIGTERM))
    evaluated = options(tmp_path, log_every=3, num_evals=2, eval_episodes=1)
    run(ppg(), PARAMS, evaluated, splits=SPLITS)
    every = ("log", "evaluate", "save")
    if stopped:
        # Whoever is asked to stop may soon be killed: first what must not be lost.
        assert done == [("log", 3), ("log", 4), ("save", 4), ("evaluate", 4)]
    else:
        logs = [("log", 3), *((name, 4) for name in every), ("log", 6)]
        assert done == [*logs, *((name, 8) for name in every)]


def test_a_run_under_other_versions_is_told(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        after(patch, 1, lambda _: signal.raise_signal(signal.SIGTERM))
        run(ppg(), PARAMS, options(tmp_path))
    about = next((tmp_path / "checkpoints").glob("*/about/metadata"))
    about.write_text(about.read_text().replace(f'"jax": "{jax.__version__}"', '"jax": "0.0.1"'))
    lines = []
    run(ppg(), PARAMS, options(tmp_path, resume="latest"), report=lines.append)
    assert any(f"jax 0.0.1 there, {jax.__version__} here" in line for line in lines)


def test_losses_that_are_not_finite_stop_the_run(tmp_path, monkeypatch):
    after(monkeypatch, 5, lambda run: run.pending[-1].update({"loss/value": jnp.float32(jnp.nan)}))
    with pytest.raises(TrainingDivergedError, match=rf"loss/value.*{4 * PER_ITERATION} steps is"):
        run(ppg(), PARAMS, options(tmp_path, checkpoint_every=PER_ITERATION))
    assert latest_steps(tmp_path / "checkpoints") == 4 * PER_ITERATION


@pytest.mark.slow
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


def test_asked_to_stop_in_its_last_iteration_a_run_is_whole(whole, tmp_path, monkeypatch):
    after(monkeypatch, ITERATIONS, lambda _: signal.raise_signal(signal.SIGINT))
    lines = []
    ended = run(ppg(), PARAMS, options(tmp_path), report=lines.append)
    assert not ended.signal
    assert not any("--resume" in line for line in lines)
    assert same(ended.state, whole[0].state)


def test_a_folder_that_cannot_be_written_to_is_told_early(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(CheckpointError, match="--output-dir"):
        run(ppg(), PARAMS, options(tmp_path / "file" / "run"))


def test_a_buffer_that_would_not_fit_is_told_with_figures(tmp_path):
    lines = []
    with pytest.raises(MemoryError, match=r"Lower num_envs, num_steps, num_policy_phases"):
        run(ppg(memory_budget_gb=1e-6), PARAMS, options(tmp_path), report=lines.append)
    assert ", buffer " in lines[0]


def test_a_policy_in_a_file_acts_as_in_training(whole):
    outcome, folder = whole
    algorithm = ppg()
    shape = algorithm.envs.env.obs_spec.shape
    pixels = np.random.default_rng(0).integers(0, 256, (5, *shape), np.uint8)
    close = partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6)
    expected = algorithm.act(outcome.state.networks, jnp.asarray(pixels))
    close(load_policy(folder / "policy.jax")(pixels), expected)

    # It needs nothing but JAX.
    np.save(folder / "pixels.npy", pixels)
    code = (
        "import sys, jax, numpy as np\n"
        "policy = jax.export.deserialize(bytearray(open('policy.jax', 'rb').read()))\n"
        "np.save('actions.npy', policy.call(np.load('pixels.npy')))\n"
        "assert not any(name.startswith(('pixelbrax', 'flax')) for name in sys.modules)\n"
    )
    environ = os.environ | {"PYTHONPATH": ""}
    subprocess.run([sys.executable, "-c", code], check=True, cwd=folder, env=environ)
    close(np.load(folder / "actions.npy"), expected)

    torch = pytest.importorskip("torch", reason="not in the lanes of other releases")
    from pixelbrax_gym import TorchPolicy

    policy = TorchPolicy(folder / "policy.jax")
    action = policy(torch.from_numpy(pixels))
    assert action.dtype == torch.float32
    close(action.numpy(), expected)
    # A view that is not contiguous is what it shows.
    turned = torch.from_numpy(pixels).flip(0)[::2]
    close(policy(turned).numpy(), expected[::-1][::2])
    with pytest.raises(ValueError, match=r"uint8 pixels, got \(5, 18, 18, 6\) float32"):
        policy(torch.from_numpy(pixels).float())
    with pytest.raises(ValueError, match=r"takes \(B, 18, 18, 6\) uint8 pixels, got \(5, 18, 18\)"):
        policy(torch.from_numpy(pixels[..., 0]))


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


@pytest.mark.slow
def test_seeds_of_one_program_are_those_of_their_own(tmp_path, monkeypatch):
    # Before rounding has grown.
    after(monkeypatch, 4, lambda _: signal.raise_signal(signal.SIGTERM))
    both = run(ppg(), PARAMS, options(tmp_path / "both", seeds=2))
    alone = run(ppg(), PARAMS, options(tmp_path / "alone", seed=1))
    second = jax.tree.map(lambda leaf: leaf[1], both.state.networks)
    assert_close(second, alone.state.networks, rtol=1e-4, atol=1e-5)
    assert (tmp_path / "both" / "policy_seed1.jax").exists()
