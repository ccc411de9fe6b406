"""Runs that are stopped from outside: real processes, terminals and disks."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from pixelbrax_jax.agents.runner.checkpoint import latest_steps
from pixelbrax_jax.agents.runner.metrics import read_metrics
from tests.agents.test_processes import PER_ITERATION, ROOT, assert_equal, command, leaves

slow = pytest.mark.slow
pytestmark = pytest.mark.timeout(600)

ITERATIONS = 250
STEPS = ITERATIONS * PER_ITERATION
OPTIONS = f"--total-steps {STEPS}"


def start(folder: Path, options: str = "", **streams) -> subprocess.Popen:
    line = command("ppo", folder, f"{OPTIONS} {options}")
    return subprocess.Popen(line, cwd=ROOT, text=True, **streams)


def finish(folder: Path, options: str = "") -> str:
    process = start(folder, options, stderr=subprocess.PIPE)
    told = process.communicate()[1]
    assert process.returncode == 0, told
    return told


def until(what: Callable[[], object]) -> None:
    end = time.monotonic() + 200
    while not what():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.01)


def under_way(folder: Path) -> bool:
    path = folder / "metrics.jsonl"
    return path.exists() and len(read_metrics(path)) >= 5


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, np.ndarray]:
    """The arrays of a run that is never stopped."""
    folder = tmp_path_factory.mktemp("whole")
    finish(folder)
    return leaves(folder, STEPS)


def assert_goes_on(folder: Path, whole: dict[str, np.ndarray]) -> None:
    """Stopped on its way, the run ends to the bit as one that never was."""
    steps = latest_steps(folder / "checkpoints")
    assert steps is not None
    assert 0 < steps < STEPS
    assert f"from the checkpoint of {steps} steps" in finish(folder, "--resume latest")
    assert_equal(leaves(folder, STEPS), whole)


class Terminal:
    """A command line of bash in a terminal of its own."""

    def __init__(self, line: str) -> None:
        if shutil.which("setsid") is None:
            pytest.skip("needs setsid, which gives a process a terminal")
        self._keys, screen = os.openpty()
        self.process = subprocess.Popen(
            ["setsid", "--ctty", "bash", "-c", line],
            **dict.fromkeys(("stdin", "stdout", "stderr"), screen),
            cwd=ROOT,
        )
        os.close(screen)
        self._reader = threading.Thread(target=self._read)
        self._open = True
        self._reader.start()

    def _read(self) -> None:
        """Empties the screen, or whoever writes to it would have to wait."""
        os.set_blocking(self._keys, False)
        while self._open:
            try:
                if not os.read(self._keys, 4096):
                    return
            except BlockingIOError:
                time.sleep(0.01)
            except OSError:  # Nobody has the terminal any more.
                return

    def press_ctrl_c(self) -> None:
        os.write(self._keys, b"\x03")

    def close(self) -> None:
        self._open = False
        self._reader.join()
        os.close(self._keys)


@slow
def test_ctrl_c_reaches_the_reader_of_the_lines_too(whole, tmp_path):
    run, status = tmp_path / "run", tmp_path / "status"
    line = shlex.join(command("ppo", run, OPTIONS)).replace("--no-progress", "--progress")
    # Bash itself survives to write the status; the signal kills tee.
    terminal = Terminal(f"{{ trap : INT; {line}; echo $? > {status}; }} 2>&1 | tee {tmp_path}/log")
    until(lambda: under_way(run))
    terminal.press_ctrl_c()
    until(lambda: status.exists() and status.read_text())
    terminal.process.wait(60)
    terminal.close()
    assert status.read_text() == "130\n"
    assert "compiling" in (tmp_path / "log").read_text()
    assert 0 < latest_steps(run / "checkpoints") < STEPS
    assert_goes_on(run, whole)


@slow
def test_the_terminal_is_closed(whole, tmp_path):
    line = shlex.join(command("ppo", tmp_path, OPTIONS)).replace("--no-progress", "--progress")
    terminal = Terminal(f"exec {line}")
    until(lambda: under_way(tmp_path))
    terminal.close()
    assert terminal.process.wait(60) == 128 + signal.SIGHUP
    assert_goes_on(tmp_path, whole)


@slow
def test_nohup_stays_in_force_and_nobody_need_read_the_lines(whole, tmp_path):
    line = shlex.join(command("ppo", tmp_path, f"{OPTIONS} --progress"))
    line = line.replace("--no-progress ", "")
    with Path("/dev/full").open("w") as full:
        ignoring = ["bash", "-c", f"trap '' HUP; exec {line}"]
        process = subprocess.Popen(ignoring, cwd=ROOT, stderr=full)
        until(lambda: under_way(tmp_path))
        process.send_signal(signal.SIGHUP)
        assert process.wait(200) == 0
    assert_equal(leaves(tmp_path, STEPS), whole)


@slow
@pytest.mark.parametrize(
    "names",
    [["SIGUSR1"], ["SIGUSR2"], ["SIGXCPU"], ["SIGTERM", "SIGHUP", "SIGINT", "SIGTERM"]],
    ids=lambda names: "-".join(names),
)
def test_what_a_scheduler_sends_stops_a_run_once(whole, tmp_path, names):
    process = start(tmp_path, stderr=subprocess.PIPE)
    until(lambda: under_way(tmp_path))
    for name in names:
        process.send_signal(getattr(signal, name))
    told = process.communicate(timeout=60)[1]
    # Python handles those that wait in the order of their numbers.
    stopped_by = signal.Signals(process.returncode - 128).name
    assert stopped_by in names[:2]
    assert told.count("stopping within two iterations") == 1
    assert f"stopped by {stopped_by} after" in told
    assert "continue with --resume latest" in told
    assert_goes_on(tmp_path, whole)


@slow
def test_ctrl_c_before_the_first_iteration(tmp_path):
    told = ""
    with start(tmp_path, stderr=subprocess.PIPE) as process:
        for line in process.stderr:
            told += line
            if "into" in line:
                process.send_signal(signal.SIGINT)
    assert process.returncode == 130
    assert "Traceback" not in told
    assert "before the first iteration; nothing is lost" in told or "no checkpoint" in told


class Disk:
    """A small disk of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._filler = folder / ".filler"

    def fill(self) -> None:
        with self._filler.open("wb", buffering=0) as file:
            try:
                while True:
                    file.write(bytes(4096))
            except OSError:
                return

    def make_room(self) -> None:
        self._filler.unlink()


@pytest.fixture
def disk(tmp_path) -> Iterator[Disk]:
    folder = tmp_path / "disk"
    folder.mkdir()
    line = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(line, capture_output=True).returncode:
        pytest.skip("may not mount a tmpfs; run as root, with CAP_SYS_ADMIN")
    yield Disk(folder)
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


@slow
@pytest.mark.parametrize("in_time", [True, False])
def test_the_disk_of_the_logs_is_full(whole, tmp_path, disk, in_time):
    run, log = disk.folder / "run", tmp_path / "log"
    (tmp_path / "checkpoints").mkdir()
    run.mkdir()
    (run / "checkpoints").symlink_to(tmp_path / "checkpoints")
    with log.open("w") as file:
        process = start(run, stderr=file)
    until(lambda: under_way(run))
    disk.fill()
    until(lambda: log.read_text().count("No space left") == 2)
    if in_time:
        disk.make_room()
    process.send_signal(signal.SIGTERM)
    # Without room for the policy that is an error, but the checkpoint is there.
    assert process.wait(60) == (128 + signal.SIGTERM if in_time else 1)
    told = log.read_text()
    assert told.count("metrics.jsonl: No space left on device; training continues") == 1
    assert ("policy.jax: No space left on device" in told) == (not in_time)
    assert ("metrics.jsonl may lack records after" in told) == (not in_time)
    if in_time:
        steps = [record["steps"] for record in read_metrics(run / "metrics.jsonl")]
        last = latest_steps(run / "checkpoints")
        assert steps == list(range(PER_ITERATION, last + 1, PER_ITERATION))
    else:
        disk.make_room()
    assert_goes_on(run, whole)


@slow
@pytest.mark.parametrize("in_time", [True, False])
def test_the_disk_of_the_checkpoints_is_full(whole, tmp_path, disk, in_time):
    run, log = tmp_path / "run", tmp_path / "log"
    run.mkdir()
    (run / "checkpoints").symlink_to(disk.folder)
    with log.open("w") as file:
        process = start(run, f"--checkpoint-every {2 * PER_ITERATION}", stderr=file)
    until(lambda: latest_steps(disk.folder))
    disk.fill()
    until(lambda: "Training continues and will retry the checkpoint" in log.read_text())
    if in_time:
        disk.make_room()
        until(lambda: "steps is written" in log.read_text())
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == (128 + signal.SIGTERM if in_time else 1)
    told = log.read_text()
    assert ("steps, is lost; that of" in told) == (not in_time)
    if not in_time:
        disk.make_room()
    assert_goes_on(run, whole)
