"""The benchmark keeps what it has measured and says what it could not."""

import json
import sys

import pytest

from tests.benchmarks import cases, run
from tests.benchmarks.cases import GROUPS, Case
from tests.benchmarks.peers import install

MACHINE = {
    "platform": "cpu",
    "device": "a device",
    "processor": "a processor",
    "cores": 2,
    "system": "a system",
    "python": "3",
    "versions": {},
    "xla_flags": "",
}
RENDERER = {
    "frames_per_second": 1.0,
    "compile_seconds": 1.0,
    "per_frame": {"temporary_bytes": 1, "output_bytes": 1, "operations": 1},
}


@pytest.fixture
def workers(monkeypatch):
    """Stands in for processes: records what is asked of them, answers or raises."""
    asked, answers = [], {}

    def worker(measure, arguments, python, timeout):
        if measure == "machine.describe":
            return {"values": MACHINE}
        asked.append((measure, arguments, python))
        answer = answers.get(measure, {"values": RENDERER, "peak_bytes": {"host": 1}})
        if isinstance(answer, Exception):
            raise answer
        return answer

    monkeypatch.setattr(run, "worker", worker)
    return asked, answers


def outcomes(folder):
    results = json.loads((folder / "cpu.json").read_text())["cases"]
    return [case["status"] for case in results.values()]


def test_what_has_been_measured_is_not_measured_again(workers, tmp_path):
    asked, _ = workers
    command = ["--only", "renderer", "--output-dir", str(tmp_path)]
    assert run.main(command) == 0
    count = len(asked)
    assert count == len(list(GROUPS["renderer"]()))
    assert run.main(command) == 0
    assert len(asked) == count
    assert run.main([*command, "--again"]) == 0
    assert len(asked) == 2 * count
    assert "| default | 256 |" in (tmp_path / "cpu.md").read_text()


def test_a_run_that_is_killed_goes_on_where_it_stopped(workers, tmp_path, monkeypatch):
    asked, _ = workers
    measure = run.measure

    def killed_at_the_third(case, timeout):
        if len(asked) == 2:
            raise KeyboardInterrupt
        return measure(case, timeout)

    command = ["--only", "renderer", "--output-dir", str(tmp_path)]
    monkeypatch.setattr(run, "measure", killed_at_the_third)
    with pytest.raises(KeyboardInterrupt):
        run.main(command)
    assert outcomes(tmp_path) == ["ok", "ok"]
    monkeypatch.setattr(run, "measure", measure)
    assert run.main(command) == 0
    assert len(asked) == len(list(GROUPS["renderer"]()))
    assert len({json.dumps(arguments) for _, arguments, _ in asked}) == len(asked)


def test_too_little_memory_is_recorded_and_the_rest_goes_on(workers, tmp_path):
    asked, answers = workers
    answers["throughput.renderer"] = MemoryError("RESOURCE_EXHAUSTED: 9 GB")
    assert run.main(["--only", "renderer", "--output-dir", str(tmp_path)]) == 0
    assert set(outcomes(tmp_path)) == {"out of memory"}
    assert len(outcomes(tmp_path)) == len(asked) > 1
    assert "RESOURCE_EXHAUSTED: 9 GB" in (tmp_path / "cpu.md").read_text()


def test_a_failure_is_recorded_and_told(workers, tmp_path):
    _, answers = workers
    answers["throughput.renderer"] = RuntimeError("something else")
    assert run.main(["--only", "renderer", "--output-dir", str(tmp_path)]) == 1
    assert set(outcomes(tmp_path)) == {"failed"}


def test_a_peer_that_cannot_be_installed_is_absent_and_not_zero(workers, tmp_path, monkeypatch):
    _, answers = workers
    scan = {"steps_per_second": 5.0}
    answers["throughput.scan"] = {"values": scan, "peak_bytes": {"host": 1}}
    monkeypatch.setattr(install, "HOME", tmp_path / "peers")
    monkeypatch.setattr(run, "peer_python", install.peer_python.__wrapped__)
    monkeypatch.setattr(install.sys, "executable", str(tmp_path / "no-such-python"))
    assert run.main(["--only", "peers", "--task", "ant", "--output-dir", str(tmp_path)]) == 0
    statuses = outcomes(tmp_path)
    assert {"ok", "absent"} == set(statuses)
    page = (tmp_path / "cpu.md").read_text()
    assert "absent" in page
    assert "cannot be installed" in page
    assert "| 0 |" not in page


@pytest.mark.parametrize(
    ("script", "error"),
    [
        ("raise MemoryError('no room')", MemoryError),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", MemoryError),
        ("raise ValueError('wrong')", RuntimeError),
        ("import sys; sys.exit('no OpenGL') if 0 else sys.exit(3)", run.AbsentError),
    ],
    ids=["memory", "killed", "error", "absent"],
)
def test_how_a_process_ends_is_understood(monkeypatch, tmp_path, script, error):
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nexec {sys.executable} -c "{script}"\n')
    python.chmod(0o755)
    with pytest.raises(error):
        run.worker("throughput.scan", {}, str(python), 60.0)


def test_a_real_case_runs_in_a_process_of_its_own():
    arguments = {"task": "inverted_pendulum", "num_envs": 2, "size": 16}
    outcome = run.measure(Case("renderer", "throughput.renderer", arguments), 300.0)
    assert outcome["status"] == "ok", outcome
    assert outcome["values"]["frames_per_second"] > 0
    assert outcome["peak_bytes"]["host"] > 1e8


def test_cases_have_names_of_their_own():
    keys = [case.key for group in GROUPS.values() for case in group()]
    assert len(set(keys)) == len(keys)
    asked = {
        (case.arguments["task"], case.arguments["num_envs"])
        for case in cases.environments()
        if case.arguments.get("obs_mode") == "pixels"
    }
    assert asked == {(task, n) for task in cases.TASKS for n in (1, 10, 100, 1000, 4096, 8192)}
