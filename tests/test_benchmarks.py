"""The benchmark keeps what it has measured and says what it could not."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import jax
import psutil
import pytest

from pixelbrax_gym.bench import adapters, throughput
from pixelbrax_gym.cli import main as pixelbrax
from tests.benchmarks import cases as all_cases
from tests.benchmarks import run, runner
from tests.benchmarks.case import TASKS, AbsentError, Case
from tests.benchmarks.cases import GROUPS
from tests.benchmarks.packages import install_packages
from tests.benchmarks.peers import install

ROOT = Path(__file__).parents[1]

MACHINE = {
    "platform": "cpu",
    "device": "a device",
    "processor": "a processor",
    "vectors": "",
    "cores": 2,
    "system": "a system",
    "python": "3",
    "versions": {},
    "xla_flags": "",
}
RENDERER = {"frames_per_second": 800.0, "compile_seconds": 1.0}
STEPS = {
    "steps_per_second": 500.0,
    "compile_seconds": 1.0,
    "bytes_per_env": 1000.0,
    "control_dt": 0.05,
}
TURN = {"steps_per_second": 97.0, "ratio": 0.97, "interval": [0.96, 0.98], "runs": 5}
WALKERS = {"task": "walker2d", "num_envs": 2}
ANSWERS = {
    "throughput.renderer": RENDERER,
    "throughput.scan": STEPS,
    "throughput.gymnasium": STEPS,
    "scaling.training": STEPS,
    "batches.compare": [{"num_envs": 10, **TURN}],
    "adapters.compare": [{"adapter": "JAX loop", "autoreset_mode": "next_step", **TURN}],
    "distractors.compare": [{"distractors": "camera", **TURN}],
    "startup.first_frame": {"seconds": {"import": 1.0, "make": 2.0}},
    "scene.describe": {},
    "dmc.pixels": {"steps_per_second": 500.0, "first_frame": {"without": 40.0, "with": 9.0}},
    "dmc.with_look": {"steps_per_second": 300.0},
    "peers.dm_control_envs": {"steps_per_second": 4.0, "processes": 2, "opengl": "a software one"},
    "peers.gymnasium_envs": {
        "steps_per_second": 5.0,
        "processes": 2,
        "versions": {"gymnasium": "3", "mujoco": "2"},
    },
    "peers.envpool_envs": {"steps_per_second": 8.0, "num_envs": 2},
    "peers.mujoco_warp_renderer": {"frames_per_second": 100.0, "versions": {"mujoco": "1"}},
}


MODULES = re.compile(r"^(pixelbrax_gym\.bench|tests\.benchmarks)\.")


@pytest.fixture
def workers(monkeypatch):
    """Stands in for processes: records what is asked of them, and answers."""
    asked, answers = [], {}

    def run_process(asked_for, environ, timeout):
        *_, what, arguments = asked_for
        measure = f"peers.{Path(what).stem}" if what.endswith(".py") else MODULES.sub("", what)
        if measure == "machine.describe":
            return {"status": "ok", "values": MACHINE}
        asked.append((measure, arguments, asked_for[0]))
        peak = {"host": 10**9, "device": None}
        done = {"status": "ok", "values": ANSWERS.get(measure), "peak_bytes": peak}
        return answers.get(measure, done)

    monkeypatch.setattr(runner, "run_process", run_process)
    return asked, answers


def outcomes(folder):
    results = json.loads((folder / "cpu.json").read_text())["cases"]
    return [case["status"] for case in results.values()]


def page_of(folder):
    """The page, with tables' padding taken away."""
    return re.sub(" +", " ", (folder / "cpu.md").read_text())


def test_what_has_been_measured_is_not_measured_again(workers, tmp_path):
    asked, _ = workers
    command = ["--only", "renderer", "--output-dir", str(tmp_path)]
    assert run.main(command) == 0
    count = len(asked)
    assert count == len(GROUPS["renderer"].cases)
    assert run.main(command) == 0
    assert len(asked) == count
    assert run.main([*command, "--again"]) == 0
    assert len(asked) == 2 * count
    assert "| default | 256 |" in page_of(tmp_path)


def test_a_run_that_is_stopped_goes_on_where_it_was(workers, tmp_path, monkeypatch, capsys):
    asked, _ = workers
    measure = runner.measure

    def killed_at_the_third(case, timeout):
        if len(asked) == 2:
            raise KeyboardInterrupt
        return measure(case, timeout)

    command = ["--only", "renderer", "--output-dir", str(tmp_path)]
    monkeypatch.setattr(runner, "measure", killed_at_the_third)
    assert run.main(command) == 130
    assert "same command again to continue" in capsys.readouterr().err
    assert outcomes(tmp_path) == ["ok", "ok"]
    monkeypatch.setattr(runner, "measure", measure)
    assert run.main(command) == 0
    assert len(asked) == len(GROUPS["renderer"].cases)
    assert len({arguments for _, arguments, _ in asked}) == len(asked)


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGUSR1", "SIGXCPU"])
def test_a_scheduler_s_signal_loses_nothing(workers, tmp_path, monkeypatch, capsys, name):
    asked, _ = workers
    measure, number = runner.measure, getattr(signal, name)
    before = signal.getsignal(number)

    def told_to_stop_at_the_third(case, timeout):
        if len(asked) == 2:
            os.kill(os.getpid(), number)
        return measure(case, timeout)

    monkeypatch.setattr(runner, "measure", told_to_stop_at_the_third)
    assert run.main(["--only", "renderer", "--output-dir", str(tmp_path)]) == 128 + number
    assert f"stopped by {name}; run the same command again" in capsys.readouterr().err
    assert outcomes(tmp_path) == ["ok", "ok"]
    assert signal.getsignal(number) is before


def test_another_machine_s_figures_are_not_taken_for_this_one_s(workers, tmp_path, monkeypatch):
    asked, _ = workers
    command = ["--only", "renderer", "--output-dir", str(tmp_path)]
    assert run.main(command) == 0
    count = len(asked)
    monkeypatch.setitem(MACHINE, "processor", "another processor")
    assert run.main([*command, "--max-envs", "8"]) == 0
    assert len(asked) == count + 1
    kept = json.loads((tmp_path / "cpu.json").read_text())
    assert {m["processor"] for m in kept["machines"].values()} == {
        "a processor",
        "another processor",
    }
    assert len({case["machine"] for case in kept["cases"].values()}) == 2


def test_cpus_with_other_vectors_have_files_of_their_own(workers, tmp_path, monkeypatch):
    command = ["--only", "renderer", "--max-envs", "8", "--output-dir", str(tmp_path)]
    for vectors in ("AVX-512", "AVX2", ""):
        monkeypatch.setitem(MACHINE, "vectors", vectors)
        assert run.main(command) == 0
    assert len(workers[0]) == 3
    monkeypatch.setitem(MACHINE, "platform", "gpu")
    monkeypatch.setitem(MACHINE, "vectors", "AVX2")
    assert run.main(command) == 0
    assert {file.name for file in tmp_path.glob("*.json")} == {
        "cpu-avx512.json",
        "cpu-avx2.json",
        "cpu.json",
        "gpu.json",
    }
    assert "a processor with AVX-512," in (tmp_path / "cpu-avx512.md").read_text()
    assert "a processor, 2 cores" in page_of(tmp_path)


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals are those of POSIX")
def test_a_benchmark_that_is_stopped_leaves_no_process_behind(tmp_path):
    command = [sys.executable, "-m", "tests.benchmarks.run", "--output-dir", str(tmp_path)]
    stopped = subprocess.Popen(command, cwd=ROOT)
    parent = psutil.Process(stopped.pid)
    while not (left := parent.children(recursive=True)):
        assert stopped.poll() is None
        time.sleep(0.1)
    stopped.terminate()
    assert stopped.wait(30.0) != 0
    assert not psutil.wait_procs(left, timeout=30.0)[1]


def test_a_file_of_another_kind_is_not_touched(workers, tmp_path):
    (tmp_path / "cpu.json").write_text('{"environment": []}')
    with pytest.raises(ValueError, match="not a result of this benchmark"):
        run.main(["--only", "renderer", "--output-dir", str(tmp_path)])
    assert (tmp_path / "cpu.json").read_text() == '{"environment": []}'


def test_what_is_misspelt_or_left_empty_is_refused(workers, capsys):
    with pytest.raises(ValueError, match="Did you mean 'ant'"):
        run.main(["--task", "antt"])
    with pytest.raises(ValueError, match="Did you mean 'peers'"):
        run.main(["--only", "peer"])
    with pytest.raises(ValueError, match="no case fits"):
        run.main(["--only", "renderer", "--task", "humanoid"])
    assert pixelbrax(["bench", "--task", "antt"]) == 1
    assert "Did you mean 'ant'" in capsys.readouterr().err
    assert pixelbrax(["bench", "--num-envs", "0"]) == 1
    assert "num_envs" in capsys.readouterr().err


def test_the_page_has_every_table_and_right_ratios(workers, tmp_path, monkeypatch):
    monkeypatch.setattr(all_cases, "peer_python", lambda peer: "python")
    groups = [group for group in GROUPS if not group.endswith("program")]
    assert run.main(["--only", *groups, "--output-dir", str(tmp_path)]) == 0
    page = page_of(tmp_path)
    for group in groups:
        assert f"## {group.capitalize()}\n" in page, group
    assert "## Not measured" not in page
    # 500 steps/s of ours over 4 of DM Control's, 12.6 of the original, 800 frames/s over 100.
    assert "| DM Control quadruped, alone | 2 | | 4.00 | 125 | a software one |" in page
    assert "| `dmc_cheetah_run` | 500 | 4.00 | 125 | 40.0 | 9.00 |" in page
    assert "| HalfCheetah | 4 | 500 | 12.6 | 39.7 |" in page
    assert "| 84 | 256 | 800 | 100 | 8.00 |" in page
    assert "gymnasium 3, mujoco 1, mujoco 2." in page
    assert "| Ant | 10 | 97.0 | 0.97 | 0.96 to 0.98 | 5 |" in page
    assert "| Ant | 256 | next_step | JAX loop | 97.0 | 0.97 | 0.96 to 0.98 | 5 |" in page
    assert (tmp_path / "cpu.png").stat().st_size > 10_000


def test_too_little_memory_is_recorded_and_the_rest_goes_on(workers, tmp_path):
    asked, answers = workers
    answers["throughput.renderer"] = {"status": "out of memory", "why": "RESOURCE_EXHAUSTED: 9 GB"}
    assert run.main(["--only", "renderer", "--output-dir", str(tmp_path)]) == 0
    assert set(outcomes(tmp_path)) == {"out of memory"}
    assert len(outcomes(tmp_path)) == len(asked) > 1
    assert "RESOURCE_EXHAUSTED: 9 GB" in page_of(tmp_path)


def test_a_failure_is_recorded_and_told(workers, tmp_path):
    _, answers = workers
    answers["throughput.renderer"] = {"status": "failed", "why": "something else"}
    assert run.main(["--only", "renderer", "--output-dir", str(tmp_path)]) == 1
    assert set(outcomes(tmp_path)) == {"failed"}


def test_a_peer_that_cannot_be_installed_is_absent_and_not_zero(workers, tmp_path, monkeypatch):
    monkeypatch.setattr(install, "HOME", tmp_path / "peers")
    monkeypatch.setattr(install.sys, "executable", str(tmp_path / "no-such-python"))
    assert run.main(["--only", "peers", "--task", "ant", "--output-dir", str(tmp_path)]) == 0
    statuses = outcomes(tmp_path)
    assert {"ok", "absent"} == set(statuses)
    assert "| DM Control quadruped, alone | 1 | | absent | - | |" in page_of(tmp_path)
    page = page_of(tmp_path)
    assert "absent" in page
    assert "cannot be installed" in page
    assert "| 0 |" not in page


def test_packages_are_installed_once_and_anew_after_a_failure(tmp_path):
    folder = tmp_path / "folder"
    create = (sys.executable, "-c", f"import os; os.mkdir({str(folder)!r})")
    fail = (sys.executable, "-c", "raise SystemExit('no such package')")
    install_packages(folder, ("a==1",), create)
    install_packages(folder, ("a==1",), fail)
    with pytest.raises(AbsentError, match="cannot be installed: no such package"):
        install_packages(folder, ("a==2",), fail)
    with pytest.raises(AbsentError):
        install_packages(folder, ("a==1",), ("no such program",))


JAX_ERROR = """
import jax
def f(x):
    raise jax.errors.JaxRuntimeError('RESOURCE_EXHAUSTED: no room for 9 GB')
jax.jit(f)(1.0)
"""


@pytest.mark.parametrize(
    ("script", "status", "why"),
    [
        ("raise MemoryError('no room')", "out of memory", "no room"),
        (JAX_ERROR, "out of memory", "no room for 9 GB"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "killed", "by the system"),
        ("raise ValueError('wrong')", "failed", "ValueError: wrong"),
        ("import sys; sys.stderr.write('no OpenGL'); sys.exit(3)", "absent", "no OpenGL"),
        ("print('no result')", "failed", "is not a result"),
    ],
    ids=["memory", "JAX's memory", "killed", "error", "absent", "no result"],
)
def test_how_a_process_ends_is_understood(script, status, why):
    outcome = runner.run_process([sys.executable, "-c", script], {}, 60.0)
    assert outcome["status"] == status
    assert why in outcome["why"]


def test_what_takes_too_long_leaves_no_process(tmp_path):
    python = tmp_path / "python"
    python.write_text(f"#!/bin/sh\nsleep 300 & echo $! > {tmp_path}/child\nwait\n")
    python.chmod(0o755)
    outcome = runner.run_process([str(python)], {}, 1.0)
    assert outcome == {"status": "failed", "why": "took longer than 1 s"}
    child = int((tmp_path / "child").read_text())
    for _ in range(100):
        state = Path(f"/proc/{child}/stat")
        if not state.exists() or state.read_text().split()[2] == "Z":
            return
        time.sleep(0.05)
    pytest.fail("the child lives")


@pytest.mark.slow
def test_a_real_case_runs_in_a_process_of_its_own():
    arguments = {"task": "inverted_pendulum", "num_envs": 2, "size": 16}
    outcome = runner.measure(Case("renderer", "throughput.renderer", arguments), 300.0)
    assert outcome["status"] == "ok", outcome
    assert outcome["values"]["frames_per_second"] > 0
    assert outcome["peak_bytes"]["host"] > 1e8


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("measure", "options"),
    [
        ("throughput.gymnasium", WALKERS),
        ("throughput.scan", WALKERS),
        ("batches.compare", {"task": "walker2d", "sizes": (2, 1), "seconds": 1.0}),
        ("adapters.compare", {**WALKERS, "seconds": 1.0}),
        ("distractors.compare", {**WALKERS, "seconds": 1.0}),
        (
            "scaling.training",
            {"task": "inverted_pendulum", "num_devices": 2, "cores": 1, "num_envs": 4},
        ),
    ],
)
def test_more_real_cases_run(measure, options):
    ours = measure in ("throughput.scan", "adapters.compare")
    package = "pixelbrax_gym.bench" if ours else "tests.benchmarks"
    kind = all_cases.DevicesCase if "num_devices" in options else Case
    outcome = runner.measure(kind("adapters", measure, options, package), 900.0)
    assert outcome["status"] == "ok", outcome


def test_cases_have_names_of_their_own():
    keys = [case.key for group in GROUPS.values() for case in group.cases]
    assert len(set(keys)) == len(keys)
    asked = {
        (case.arguments["task"], case.arguments["num_envs"])
        for case in GROUPS["environments"].cases
        if case.arguments.get("obs_mode") == "pixels"
    }
    assert asked == {(task, n) for task in TASKS for n in (1, 10, 100, 1000, 4096, 8192)}


def test_the_command_measures_this_machine(monkeypatch, tmp_path, capsys):
    calls = {"state": 50.0, "pixels": 20.0}

    def scan(task, num_envs, obs_mode="pixels"):
        assert (task, num_envs) == ("reacher", 7)
        return {"steps_per_second": num_envs * calls[obs_mode]}

    monkeypatch.setattr(throughput, "renderer", lambda *_: {"frames_per_second": 630.0})
    monkeypatch.setattr(throughput, "scan", scan)
    monkeypatch.setattr(adapters, "compare", lambda *_: ANSWERS["adapters.compare"])
    file = tmp_path / "new" / "bench.json"
    line = ["bench", "--task", "reacher", "--num-envs", "7", "--output", str(file)]
    assert pixelbrax(line) == 0
    page = re.sub(" +", " ", capsys.readouterr().out)
    assert "reacher, 7 environments, 84 x 84" in page
    assert "frames, from link poses 630 a second" in page
    assert "steps without images, a compiled loop 350 a second" in page
    assert "steps with images, a compiled loop 140 a second" in page
    assert "| JAX loop | next_step | 97.0 | 0.97 | 0.96 to 0.98 | 5 |" in page
    kept = json.loads(file.read_text())
    assert (kept["state_steps_per_second"], kept["steps_per_second"]) == (350, 140)
    assert kept["adapters"] == ANSWERS["adapters.compare"]
    assert kept["machine"]["versions"]["jax"]

    def too_large(*_):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: 9 GB")

    monkeypatch.setattr(throughput, "renderer", too_large)
    assert pixelbrax(["bench"]) == 1
    assert "9 GB; if memory ran out, lower --num-envs" in capsys.readouterr().err


def test_adapters_that_are_not_installed_are_left_out(monkeypatch):
    monkeypatch.setattr(adapters, "find_spec", lambda name: None)
    monkeypatch.setattr(adapters.pb, "make", lambda task: (SimpleNamespace(action_size=1), None))
    for name in ("scan", "loop", "_gymnasium"):
        monkeypatch.setattr(adapters, name, lambda *given: lambda: None)
    found = adapters.compare("ant", 64, seconds=0.0)
    assert [row["adapter"] for row in found] == [
        "JAX scan",
        "JAX loop",
        "Gymnasium, jax",
        "Gymnasium, numpy",
    ]
