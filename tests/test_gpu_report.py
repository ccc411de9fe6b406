"""The report on a GPU: its order, what a cut run keeps, what it says of machines, its tables."""

from __future__ import annotations

import json
import os
import signal
import stat
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import psutil
import pytest

from tests.benchmarks.gpu_report import __main__ as gpu_report
from tests.benchmarks.gpu_report import card, plan, plots, programs, schedule, tables
from tests.benchmarks.gpu_report.card import CardError, check_card, parse_card, read_card
from tests.benchmarks.gpu_report.plan import CARD, REHEARSAL, Timed
from tests.benchmarks.gpu_report.results import Results

LINE = "NVIDIA H100 80GB HBM3, 580.65.06, 81559, 81000, 9.0, Default"
H100 = parse_card(LINE)
MACHINE = {
    "platform": "cpu",
    "device": "cpu",
    "processor": "a processor",
    "vectors": "",
    "cores": 2,
    "system": "Linux",
    "python": "3.12",
    "versions": {"jax": "0.11.2"},
    "xla_flags": "",
    "renderer": "fused",
    "why": "JAX computes on a cpu",
    "rehearsal": True,
    "card": None,
}


# What is measured, and in which order.


def groups(cases):
    return list(dict.fromkeys(case.group for case in cases))


def test_the_most_wanted_comes_first():
    cases = plan.plan(CARD)
    assert groups(cases) == ["kernel", "speeds", "adapters", "learning", "tests", "renderers"]
    first = next(case for case in cases if case.group == "speeds")
    assert first.arguments == {
        "task": "halfcheetah", "num_envs": 8192, "size": 84, "policy": "random", "flags": "",
        "engine": "auto",
    }  # fmt: skip
    assert len({case.key for case in cases}) == len(cases)


def test_the_grid_is_whole():
    cases = plan.plan(CARD)
    grid = {
        tuple(case.arguments[name] for name in ("task", "num_envs", "size", "policy"))
        for case in cases
        if case.group == "speeds" and case.arguments["engine"] == "auto"
        if not case.arguments["flags"]
    }
    assert len(grid) == 6 * 4 * 3 * 2
    checked = {case.arguments["task"] for case in cases if case.group == "kernel"}
    assert checked == set(plan.TASKS)


def test_without_the_kernel_its_checks_are_left_out():
    cases = plan.plan(CARD, kernel=False)
    assert groups(cases)[0] == "speeds"
    assert all(case.arguments.get("renderer") != "pallas" for case in cases)


def test_large_cases_are_left_out_of_a_small_card(capsys):
    small = parse_card("A card, 580.65.06, 4096, 2900, 8.6, Default")
    kept = gpu_report._that_fit(plan.plan(CARD), small)
    steps = [case.arguments for case in kept if case.group == "speeds"]
    assert max(case["num_envs"] for case in steps if case["size"] == 84) == 1024
    assert max(case["num_envs"] for case in steps if case["size"] is None) == 8192
    assert "need more than the 2.8 GB that are free" in capsys.readouterr().err


# A run that is cut.


@dataclass(frozen=True)
class Fake(Timed):
    """A case whose process is a few lines of Python: no JAX."""

    script: str = ""
    least: float = 0.1

    def command(self):
        return [sys.executable, "-c", self.script]


def fake(name, wait=0.0, measure=0.0, after=""):
    script = f"""
import sys, time
time.sleep({wait})
print("READY 1.5", flush=True)
if not sys.stdin.readline(): sys.exit(9)
time.sleep({measure})
{after}
print('RESULT {{"values": {{"steps_per_second": 5.0}}}}', flush=True)
"""
    return Fake("speeds", name, {"task": "ant"}, script=script)


def run(cases, seconds=120.0, parallel=2, patience=10.0):
    found = {}
    record = lambda case, outcome: found.update({case.measure: outcome})  # noqa: E731
    schedule.run(cases, record, seconds, parallel, dict(os.environ), patience)
    return found


def test_cases_are_timed_in_their_order_one_at_a_time():
    cases = [fake("slow", wait=0.6), fake("quick"), fake("third")]
    found = run(cases)
    assert list(found) == ["slow", "quick", "third"]
    assert {outcome["status"] for outcome in found.values()} == {"ok"}
    assert found["slow"]["values"] == {"steps_per_second": 5.0}
    assert found["slow"]["prepared_seconds"] == 1.5


def test_nothing_computes_beside_what_is_timed(tmp_path):
    """The second one, which would write the time all along, is paused meanwhile."""
    ticks = tmp_path / "ticks"
    script = f"""
import time
from pathlib import Path
for _ in range(60):
    with Path({str(ticks)!r}).open("a") as file: print(time.time(), file=file)
    time.sleep(0.02)
print("READY 1", flush=True); input()
print('RESULT {{"values": 1}}', flush=True)
"""
    span = tmp_path / "span"
    note = f"open({str(span)!r}, 'a').write(f'{{time.time()}} ')"
    first = fake("first", wait=0.3, measure=0.5, after=note)
    found = run([first, Fake("speeds", "ticks", {}, script=script)])
    assert [outcome["status"] for outcome in found.values()] == ["ok", "ok"]
    end = float(span.read_text())
    times = [float(line) for line in ticks.read_text().split()]
    assert any(t > end for t in times)
    assert not [t for t in times if end - 0.4 < t < end]


def test_failures_have_their_reasons(monkeypatch):
    monkeypatch.setattr(schedule, "GRACE", 0.2)
    broken = Fake("speeds", "broken", {}, script="raise RuntimeError('no such task')")
    absent = Fake("speeds", "absent", {}, script="import sys; sys.exit('x' and 3)")
    memory = Fake("speeds", "memory", {}, script="raise MemoryError('out of memory')")
    slow = fake("slow", wait=60)
    long = replace(fake("long", measure=60), seconds=0.2)
    found = run([broken, absent, memory, slow, long], patience=2.0)
    status = {name: outcome["status"] for name, outcome in found.items()}
    assert status == {
        "broken": "failed", "absent": "absent", "memory": "out of memory", "slow": "failed",
        "long": "failed",
    }  # fmt: skip
    assert "no such task" in found["broken"]["why"]
    assert "compiled for longer" in found["slow"]["why"]
    assert "took longer than 0 s" in found["long"]["why"]


def test_the_end_comes_in_time_and_what_is_ready_is_still_timed():
    # Python's own, such as the tracker of shared memory that another test needed.
    before = set(psutil.Process().children())
    began = time.monotonic()
    found = run([fake("endless", wait=60), fake("ready")], seconds=4)
    assert time.monotonic() - began < 10
    assert list(found) == ["ready"]
    assert set(psutil.Process().children()) <= before


def test_a_worker_ends_with_whoever_started_it(tmp_path):
    """Even if that one is killed while the worker is paused."""
    script = f"""
import os, signal, time
from pathlib import Path
from tests.benchmarks.gpu_report.schedule import Process
from tests.benchmarks.gpu_report.plan import Timed
process = Process(Timed("x", "checks.identity"), dict(os.environ))
process.ready.wait()
assert process.prepared_seconds is not None
process.signal(signal.SIGSTOP)
Path({str(tmp_path / "pid")!r}).write_text(str(process._process.pid))
time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", script]) as parent:
        file = tmp_path / "pid"
        while not file.exists() or not file.read_text():
            time.sleep(0.05)
        worker = psutil.Process(int(file.read_text()))
        parent.kill()
    assert not psutil.wait_procs([worker], timeout=5)[1]


def test_results_outlive_a_kill_and_are_not_measured_again(tmp_path):
    results = Results(tmp_path)
    results.start(MACHINE)
    case, other = fake("one"), fake("two")
    results.add(case, {"status": "ok", "values": {}})
    results.add(other, {"status": "failed", "why": "no"})
    with results.file.open("a") as file:
        file.write('{"key": "half a li')
    again = Results(tmp_path)
    again.start(MACHINE)
    assert again.has(case)
    assert not again.has(other)
    again.add(other, {"status": "ok", "values": {}})
    assert Results(tmp_path).has(other)


def test_another_machine_needs_another_folder(tmp_path):
    Results(tmp_path).start(MACHINE)
    with pytest.raises(ValueError, match=r"--output-dir .* \(device cpu, here NVIDIA H100"):
        Results(tmp_path).start(MACHINE | {"device": "NVIDIA H100"})


# What stands in the way.


def program(tmp_path, monkeypatch, text, status=0):
    """Stands in for nvidia-smi."""
    file = tmp_path / "nvidia-smi"
    file.write_text(f"#!/bin/sh\necho '{text}'\nexit {status}\n")
    file.chmod(file.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")


def test_a_machine_without_a_gpu(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert gpu_report.main(["--output-dir", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    assert "no NVIDIA GPU" in told
    assert "--rehearse" in told
    assert not (tmp_path / "out").exists()


def test_what_nvidia_smi_says(tmp_path, monkeypatch):
    program(tmp_path, monkeypatch, LINE)
    found = read_card({})
    assert (found.name, found.capability, found.exclusive) == ("NVIDIA H100 80GB HBM3", 9.0, False)
    assert found.free_gb == pytest.approx(81000 / 1024)
    with pytest.raises(CardError, match="CUDA_VISIBLE_DEVICES='' hides every GPU"):
        read_card({"CUDA_VISIBLE_DEVICES": ""})
    program(tmp_path, monkeypatch, "NVIDIA-SMI has failed to talk to the driver", 9)
    with pytest.raises(CardError, match="failed to talk to the driver"):
        read_card({})


@pytest.mark.parametrize(
    ("changes", "cuda", "environ", "told"),
    [
        ({}, [], {}, r"without CUDA: `make gpu-report CUDA=cuda13`"),
        ({"driver": "535.1"}, [13], {}, r"CUDA 13, which needs .* 580 .*CUDA=cuda12"),
        ({"driver": "470.1"}, [12], {}, r"470.1 of the .* too old: JAX needs 525"),
        ({"free_gb": 1.0}, [12], {}, r"1.0 GB of 79.6 GB are free"),
        ({"mode": "Prohibited"}, [12], {}, r"nvidia-smi -c DEFAULT"),
        ({}, [12], {"JAX_PLATFORMS": "cpu"}, r"JAX_PLATFORMS='cpu' hides the NVIDIA H100"),
    ],
)
def test_what_stands_in_the_way_is_said_with_the_fix(changes, cuda, environ, told):
    found = card.Card(**{**vars(H100), **changes})
    with pytest.raises(CardError, match=told) as error:
        check_card(found, cuda, environ)
    assert "--rehearse" in str(error.value)


def test_an_old_card_is_told_what_it_does_without():
    assert check_card(H100, [12], {}) == []
    (note,) = check_card(card.Card(**{**vars(H100), "capability": 7.5}), [12], {})
    assert "7.5" in note
    assert "left out" in note


def test_bad_options_are_named(tmp_path, capsys):
    with pytest.raises(SystemExit, match="--minutes must be greater than 0, got 0"):
        gpu_report.main(["--minutes", "0"])
    assert gpu_report.main(["--tables-only", "--output-dir", str(tmp_path)]) == 2
    assert "has no results" in capsys.readouterr().err


# Tables and plots.


VALUES = {
    "checks.kernel": [
        {"shadows": False, "same": 1.0, "apart": 1, "contrast": 9.0},
        {"shadows": True, "same": 0.9985, "apart": 77, "contrast": 9.0},
    ],
    "speeds.steps": {"steps_per_second": 1234.5},
    "speeds.frames": {"frames_per_second": 9000.0},
    "renderers.mjx": {"frames_per_second": 3000.0},
    "sharing.compare": {
        "shared": {"frames": True, "back": False},
        "adapters": [
            {
                "adapter": "JAX loop", "autoreset_mode": "next_step", "steps_per_second": 97.0,
                "ratio": 0.97, "interval": [0.96, 0.98], "runs": 5,
            }
        ],
    },
    "programs.learning": {
        "curve": [[10.0, 100, 1.0], [31.0, 300, 250.0]],
        "steps": 300,
        "seconds": 31.0,
        "first_update_seconds": 9.0,
        "steps_per_second": 10.0,
    },
    "programs.tests": {"counts": {"passed": 3, "failed": 1}, "failed": ["a::b"], "finished": None},
}  # fmt: skip


@pytest.fixture
def measured(tmp_path):
    """A folder with outcomes of a rehearsal, some of them missing."""
    results = Results(tmp_path)
    results.start(MACHINE)
    for case in plan.plan(REHEARSAL)[:-4]:
        found = VALUES.get(case.measure)
        results.add(
            case,
            {"status": "ok", "values": found, "prepared_seconds": 7.5}
            if found
            else {"status": "absent", "why": "no wheel"},
        )
    return tmp_path


def test_tables_of_what_there_is(measured):
    assert gpu_report.main(["--tables-only", "--output-dir", str(measured)]) == 0
    page = " ".join((measured / "report.md").read_text().split(" "))
    page = "\n".join(" ".join(line.split()) for line in page.splitlines())
    assert "# Measurements on cpu" in page
    assert "| InvertedPendulum | 100.000 | 1 | 99.850 | 77 |" in page
    assert "| InvertedPendulum | 48 x 48 | random | 1,230 | 1,230 | 7.50 |" in page
    assert "not yet" in page
    assert "frames: shared without a copy; back: COPIED" in page
    assert "return at 30 s" in page
    assert "3 passed, 1 failed, then the time was over." in page
    assert "* failed: `a::b`" in page
    assert "`mjx.render` | 3,000 | 3.00 |" in page
    assert "no wheel" in page
    assert "| speeds | 4 |" in page
    whole = json.loads((measured / "report.json").read_text())
    assert whole["machine"]["device"] == "cpu"
    for name in ("speeds", "learning"):
        assert (measured / f"{name}.png").stat().st_size > 5000


def test_an_empty_report_has_tables(tmp_path):
    page = tables.page(MACHINE, [], plan.plan(REHEARSAL))
    assert "Not reached" in page
    assert plots.draw([], tmp_path) == []


def test_tests_of_a_cut_log_are_counted():
    log = """
tests/gpu/test_sharing.py::test_a PASSED [ 10%]
[gw0] [ 20%] FAILED tests/gpu/test_sharing.py::test_b[x]
tests/gpu/test_sharing.py::test_c SKIPPED (no) [ 30%]
tests/gpu/test_sharing.py::test_d
"""
    found = programs.count_tests(log)
    assert found["counts"] == {"passed": 1, "failed": 1, "skipped": 1}
    assert found["failed"] == ["tests/gpu/test_sharing.py::test_b[x]"]
    assert found["finished"] is None
    ended = log + "=== 1 failed, 1 passed, 1 skipped in 3.1s ===\n"
    assert programs.count_tests(ended)["finished"].startswith("1 failed")


def test_a_program_is_stopped_at_its_limit(monkeypatch):
    monkeypatch.setattr(programs, "STOPPING", 5.0)
    script = "import time\ntry: time.sleep(60)\nexcept KeyboardInterrupt: print('kept')"
    text, status = programs.run_program([sys.executable, "-c", script], 6.0, {})
    assert (text.strip(), status) == ("kept", None)
    assert programs.run_program([sys.executable, "-c", "print(1); exit(4)"], 9.0, {}) == ("1\n", 4)


def test_a_learning_curve_is_short():
    records = [{"seconds": float(t), "steps": 10 * t, "episode/return": 1.0} for t in range(1000)]
    found = programs.curve(records)
    assert 150 <= len(found["curve"]) <= 250
    assert found["steps_per_second"] == pytest.approx(10.0)


# The real thing, small.


def test_ctrl_c_keeps_what_there_is(tmp_path, monkeypatch):
    """A stop between two cases leaves the first one's outcome and its tables."""

    def identity(case, outcome):
        outcome({"status": "ok", "values": {k: v for k, v in MACHINE.items() if k != "card"}})

    def fake_run(cases, record, *_):
        if cases[0].group == "card":
            return identity(cases[0], lambda found: record(cases[0], found))
        record(cases[0], {"status": "ok", "values": VALUES[cases[0].measure]})
        os.kill(os.getpid(), signal.SIGINT)
        return time.sleep(5)

    monkeypatch.setattr(schedule, "run", fake_run)
    arguments = ["--rehearse", "--output-dir", str(tmp_path)]
    assert gpu_report.main(arguments) == 130
    assert "| InvertedPendulum |" in (tmp_path / "report.md").read_text()
    assert len(Results(tmp_path).rows) == 1


@pytest.mark.slow
def test_a_case_of_the_smallest_size():
    case = plan.steps("inverted_pendulum", 2, None, "network")
    environ = {**os.environ, "JAX_PLATFORMS": "cpu"}
    found = {}
    schedule.run([case], lambda _, outcome: found.update(outcome), 120.0, 1, environ)
    assert found["status"] == "ok", found
    assert found["values"]["steps_per_second"] > 0
    assert Path(found.get("why", "")) == Path()
