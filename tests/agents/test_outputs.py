"""Training continues and reports messages, bars, records and checkpoints that cannot be written."""

from __future__ import annotations

import os
import resource
import signal
import struct
import sys
import time
from contextlib import contextmanager
from types import SimpleNamespace

import jax.numpy as jnp
import pytest
from tensorboardX.proto.event_pb2 import Event
from tensorboardX.record_writer import masked_crc32c

from pixelbrax_jax import stop_signals
from pixelbrax_jax.agents.on_policy.ppo import PPO, PPOConfig
from pixelbrax_jax.agents.runner import checkpoint, metrics, train
from pixelbrax_jax.agents.runner.checkpoint import (
    CheckpointError,
    Checkpoints,
    all_steps,
    latest_steps,
)
from pixelbrax_jax.agents.runner.metrics import AppendedFile, open_metrics, read_metrics
from pixelbrax_jax.agents.runner.progress import Bar
from pixelbrax_jax.agents.runner.settings import RunConfig
from pixelbrax_jax.agents.runner.train import run
from tests.agents.small import ABOUT, PARAMS, SMALL, ball_envs, same, with_iterate

PER_ITERATION = SMALL["num_envs"] * SMALL["num_steps"]


@contextmanager
def files_of_at_most(size: int):
    """The system takes a part of what goes beyond, and refuses the rest."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def events(folder) -> list[Event]:
    """What TensorBoard reads; a wrong length or checksum is an error."""
    (path,) = (folder / "tensorboard").iterdir()
    data, found = path.read_bytes(), []
    while data:
        length, of_length = data[:8], data[8:12]
        end = 12 + struct.unpack("<Q", length)[0]
        body, of_body, data = data[12:end], data[end : end + 4], data[end + 4 :]
        assert struct.unpack("<I", of_length)[0] == masked_crc32c(length)
        assert struct.unpack("<I", of_body)[0] == masked_crc32c(body)
        found.append(Event.FromString(body))
    return found


def test_what_a_disk_does_not_take_is_written_later(tmp_path):
    file = AppendedFile(tmp_path / "file")
    file.append(b"one two ")
    with files_of_at_most(11):
        for block in (b"three ", b"four "):
            with pytest.raises(OSError, match="File too large"):
                file.append(block)
    assert (tmp_path / "file").read_bytes() == b"one two thr"
    file.append(b"five")
    file.close()
    assert (tmp_path / "file").read_bytes() == b"one two three four five"


def test_no_more_than_so_much_waits(tmp_path, monkeypatch):
    monkeypatch.setattr(metrics, "_MAX_WAITING", 10)
    file = AppendedFile(tmp_path / "file")
    with files_of_at_most(0):
        for block in (b"123456", b"7890", b"lost"):
            with pytest.raises(OSError, match="too large"):
                file.append(block)
    # Records after a gap would tell a wrong story: the file ends before it.
    for _ in range(2):
        with pytest.raises(OSError, match="64 MiB waited"):
            file.append(b"later")
    with pytest.raises(OSError, match="64 MiB waited"):
        file.close()
    assert (tmp_path / "file").read_bytes() == b"1234567890"


def test_records_are_complete_when_there_is_room_again(tmp_path):
    told = []
    writer = open_metrics(tmp_path, {}, told.append, first_step=7)
    with files_of_at_most(100):
        for steps in (10, 20, 2**33):
            writer.write(steps, {"loss/value": 0.5, "learning_rate": 0.25})
        assert len(told) == 2, "once each"
        assert all("training continues, its records wait in memory" in line for line in told)
        assert len(writer.missing()) == 2
    writer.write(2**33 + 1, {"loss/value": 1.5})
    assert len(told) == 4
    assert all("missing records were added" in line for line in told[2:])
    writer.close()
    assert writer.missing() == []
    steps = [10, 20, 2**33, 2**33 + 1]
    assert [record["steps"] for record in read_metrics(tmp_path / "metrics.jsonl")] == steps
    version, start, *rest = events(tmp_path)
    assert (version.file_version, version.step) == ("brain.Event:2", 8)
    assert (start.session_log.status, start.step) == (1, 8), "what is later is forgotten"
    assert [event.step for event in rest] == steps
    values = {value.tag: value.simple_value for value in rest[0].summary.value}
    assert values == {"loss/value": 0.5, "learning_rate": 0.25}


def test_a_disk_that_stays_full_is_told_at_the_end(tmp_path):
    told = []
    writer = open_metrics(tmp_path, {}, told.append)
    writer.write(10, {"x": 1.0})
    with files_of_at_most(60):
        writer.write(20, {"x": 1.0})
        writer.close()
    assert len(told) == len(writer.missing()) == 2
    assert "metrics.jsonl may lack records after 10 steps: File too large" in writer.missing()[0]


def test_weights_and_biases_may_fail(tmp_path, monkeypatch):
    logged = []

    class Run:
        def define_metric(self, names, step_metric):
            assert (names, step_metric) == ("*", "steps")

        def log(self, record):
            logged.append(record["steps"])
            if len(logged) == 2:
                raise RuntimeError("the service has died\nand more")

        def finish(self):
            raise RuntimeError("the service is dead")

    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=lambda **_: Run()))
    told = []
    writer = open_metrics(tmp_path, {}, told.append, wandb_project="p")
    for steps in (1, 2, 3):
        writer.write(steps, {"x": 0.0})
    writer.close()
    assert logged == [1, 2], "what has failed is left alone"
    assert told == [
        "cannot write to Weights & Biases: the service has died; training continues, "
        f"{tmp_path / 'metrics.jsonl'} has all records"
    ]
    (missing,) = writer.missing()
    assert "Weights & Biases may lack records after 1 steps" in missing
    assert len(read_metrics(tmp_path / "metrics.jsonl")) == 3


def test_weights_and_biases_may_not_start(tmp_path, monkeypatch):
    class CommError(Exception):
        pass

    def init(**_):
        raise CommError("api_key not configured (no-tty)")

    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=init))
    told = []
    writer = open_metrics(tmp_path, {}, told.append, wandb_project="p")
    writer.write(1, {"x": 0.0})
    writer.close()
    assert len(read_metrics(tmp_path / "metrics.jsonl")) == 1
    (line,), (missing,) = told, writer.missing()
    assert "cannot log to Weights & Biases: api_key not configured (no-tty)" in line
    assert "api_key not configured" in missing


def test_a_run_of_weights_and_biases_that_fails_early_is_finished(tmp_path, monkeypatch):
    finished = []

    def define_metric(*_, **__):
        raise RuntimeError("no metric")

    run = SimpleNamespace(define_metric=define_metric, finish=lambda: finished.append(True))
    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=lambda **_: run))
    told = []
    open_metrics(tmp_path, {}, told.append, wandb_project="p").close()
    assert finished == [True]
    assert "cannot log to Weights & Biases: no metric" in told[0]


def test_a_resumed_run_is_one_run_of_weights_and_biases(tmp_path, monkeypatch):
    given = []

    def init(**options):
        given.append(options)
        return SimpleNamespace(define_metric=lambda *_, **__: None, finish=lambda: None)

    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=init))
    for folder in ("a", "a", "b"):
        open_metrics(tmp_path / folder, {}, print, wandb_project="p").close()
    one, again, other = (options["id"] for options in given)
    assert one == again != other
    assert {options["resume"] for options in given} == {"allow"}


class BrokenPipe:
    encoding = "utf-8"

    def write(self, text):
        raise BrokenPipeError(32, "Broken pipe")

    def flush(self):
        raise BrokenPipeError(32, "Broken pipe")


def test_a_bar_is_shown_on_terminals_unless_asked_for(monkeypatch):
    yes, no = (SimpleNamespace(isatty=lambda told=told: told) for told in (True, False))
    for terminal in (yes, no, None):
        monkeypatch.setattr(sys, "stderr", terminal)
        assert RunConfig().progress == bool(terminal and terminal.isatty())
        assert RunConfig(progress=True).progress


def test_a_bar_that_cannot_be_drawn_is_told_once(monkeypatch):
    monkeypatch.setattr(sys, "stderr", BrokenPipe())
    told = []
    bar = Bar(True, 10, told.append)
    for _ in range(3):
        bar.update(1)
        bar.set_postfix(episode_return="1.0")
    bar.close()
    assert told == ["the progress bar cannot be drawn: Broken pipe; the run continues without it"]


@pytest.mark.slow
def test_a_run_without_a_reader_is_the_same(tmp_path, monkeypatch):
    def ppo():
        return PPO(PPOConfig(**SMALL), ball_envs())

    def report(line):
        raise BrokenPipeError(32, "Broken pipe")

    quiet = run(ppo(), PARAMS, RunConfig(str(tmp_path / "a"), progress=False))
    monkeypatch.setattr(sys, "stderr", BrokenPipe())
    # A clock that asks for a checkpoint after every iteration, as far as it can.
    options = RunConfig(
        str(tmp_path / "b"), checkpoint_minutes=1e-9, keep_checkpoints=9, progress=True
    )
    outcome = run(ppo(), PARAMS, options, report=report)
    assert same(outcome.state, quiet.state)
    assert quiet.incomplete == ()
    assert outcome.incomplete == (
        "the progress bar could not be shown: Broken pipe",
        "messages could not be shown: Broken pipe",
    )
    for name, number in (("a", 1), ("b", 5)):
        assert len(list((tmp_path / name / "checkpoints").glob("*[0-9]"))) == number


def test_a_policy_that_cannot_be_written_costs_no_checkpoint(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(train, "save_policy", full)
    small = PPO(PPOConfig(**SMALL), ball_envs())
    algorithm = with_iterate(
        small,
        lambda state, env_params: (
            state.replace(iteration=state.iteration + 1),
            {"episode/count": jnp.float32(0.0)},
        ),
    )
    with pytest.raises(OSError, match=r"policy.jax: No space left.*160 steps is complete"):
        run(algorithm, PARAMS, RunConfig(str(tmp_path), progress=False))
    assert latest_steps(tmp_path / "checkpoints") == 5 * PER_ITERATION


def test_a_checkpoint_is_tried_again(tmp_path, monkeypatch):
    free, now, told = [1 << 40], [0.0], []
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=free[0]))
    monkeypatch.setattr(checkpoint, "time", SimpleNamespace(monotonic=lambda: now[0]))
    checkpoints = Checkpoints(tmp_path, ABOUT, minutes=10, report=told.append)
    state = {"x": jnp.arange(3)}
    assert not checkpoints.is_due_by_clock()
    now[0] = 600
    assert checkpoints.is_due_by_clock()
    checkpoints.save(state, 10, None)
    checkpoints.look_after(wait=True)
    assert not checkpoints.is_due_by_clock()
    free[0] = 1
    for steps in (20, 30):
        checkpoints.save(state, steps, None)
    (line,) = told
    assert "Training continues" in line
    now[0] = 661
    assert checkpoints.is_due_by_clock(), "sooner than usual"
    free[0] = 1 << 40
    checkpoints.save(state, 40, None)
    checkpoints.look_after(wait=True)
    assert told[1:] == ["the checkpoint of 40 steps is written"]
    free[0] = 1
    with pytest.raises(CheckpointError, match="of 50 steps, is lost; that of 40 steps remains"):
        checkpoints.save(state, 50, None, last=True)
    assert all_steps(tmp_path) == [10, 40]
    checkpoints.close()


def test_a_checkpoint_that_fails_while_it_is_written_leaves_the_others(tmp_path, caplog):
    told = []
    checkpoints = Checkpoints(tmp_path, ABOUT, keep=1, every=10, report=told.append)
    state = {"x": jnp.arange(300_000.0) % 7919 * 1.37}
    checkpoints.save(state, 10, None, last=True)
    with files_of_at_most(5_000):
        checkpoints.save(state, 20, None)
        end = time.monotonic() + 60
        while not told and time.monotonic() < end:
            checkpoints.look_after()
            time.sleep(0.01)
    assert "File too large" in told[0]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["10"], "and nothing half written"
    assert latest_steps(tmp_path) == 10
    assert not [record for record in caplog.records if record.exc_info], "no traceback"
    assert not checkpoints.is_due_after(29)
    checkpoints.save(state, 30, None, last=True)
    assert all_steps(tmp_path) == [30]
    checkpoints.close()


def test_only_a_second_ctrl_c_stops_at_once(monkeypatch):
    now, lines = [100.0], []
    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(stop_signals, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with stop_signals.stop_requests(lines.append) as request:
        assert not request.signal
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGTERM, signal.SIGINT):
            signal.raise_signal(number)
            now[0] += 5
        assert request.signal == signal.SIGTERM, "the first one"
        assert len(lines) == 1
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    with stop_signals.stop_requests(lines.append):
        # One key press that a wrapper passes on again.
        for _ in range(2):
            signal.raise_signal(signal.SIGINT)
            now[0] += 0.1
    assert signal.getsignal(signal.SIGINT) is before


NUMBERS = [
    getattr(signal, name)
    for name in ("SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2", "SIGXCPU")
    if hasattr(signal, name)
]


@pytest.mark.parametrize("number", NUMBERS)
def test_what_schedulers_send_is_a_request_to_stop_unless_the_program_uses_it(number):
    lines, got, before = [], [], signal.getsignal(number)
    with stop_signals.stop_requests(lines.append) as request:
        os.kill(os.getpid(), number)
        assert request.signal == number
    assert lines[0].startswith(f"{number.name}: stopping within two iterations, with a checkpoint")
    assert signal.getsignal(number) is before
    if number == signal.SIGTERM:
        return
    # Launchers requeue a job on the others, and ``nohup`` ignores one.
    try:
        for handler in (lambda number, _: got.append(number), signal.SIG_IGN):
            signal.signal(number, handler)
            with stop_signals.stop_requests(lines.append) as request:
                os.kill(os.getpid(), number)
                assert (request.signal, got) == (0, [number])
    finally:
        signal.signal(number, before)
