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

import psutil
import pytest

from pixelbrax_gym.bench import adapters, cases, command, report, runner
from pixelbrax_gym.bench.case import AbsentError, Case
from pixelbrax_gym.bench.packages import install_packages
from tests.benchmarks import cases as all_cases
from tests.benchmarks import run
from tests.benchmarks.cases import GROUPS
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
RENDERER = {
    "frames_per_second": 800.0,
    "compile_seconds": 1.0,
    "temporary_bytes": 1,
    "output_bytes": 1,
    "operations_per_frame": 1e6,
}
STEPS = {
    "steps_per_second": 500.0,
    "compile_seconds": 1.0,
    "bytes_per_env": 1000.0,
    "bytes_on_a_device": 10**6,
    "control_dt": 0.05,
}
TURN = {"steps_per_second": 97.0, "ratio": 0.97, "interval": [0.96, 0.98], "runs": 5}
WALKERS = {"task": "walker2d", "num_envs": 2}
ANSWERS = {
    "throughput.renderer": RENDERER,
    "throughput.scan": STEPS,
    "throughput.gymnasium": STEPS,
    "scaling.stepping": STEPS,
    "scaling.training": STEPS,
    "batches.compare": [{"num_envs": 10, **TURN}],
    "adapters.compare": [{"adapter": "JAX loop", "autoreset_mode": "next_step", **TURN}],
    "distractors.compare": [{"distractors": "camera", **TURN}],
    "bank.load": {"frames": 4200, "file_bytes": 2e8, "bank_bytes": 1e8, "seconds": {"read": 9.0}},
    "startup.first_frame": {"seconds": {"import": 1.0, "make": 2.0}},
    "scene.describe": {},
    "dmc.pixels": {"steps_per_second": 500.0, "first_frame": {"without": 40.0, "with": 9.0}},
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
    """Stands in for processes: records what is asked of them, answers or raises."""
    asked, answers = [], {}

    def process(asked_for, environ, timeout):
        *_, what, arguments = asked_for
        measure = f"peers.{Path(what).stem}" if what.endswith(".py") else MODULES.sub("", what)
        if measure == "machine.describe":
            return {"values": MACHINE}
        asked.append((measure, arguments, asked_for[0]))
        answer = answers.get(measure, ANSWERS[measure])
        if isinstance(answer, Exception):
            raise answer
        return {"values": answer, "peak_bytes": {"host": 10**9, "device": None}}

    monkeypatch.setattr(runner, "process", process)
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
    assert count == len(list(GROUPS["renderer"].cases()))
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
    assert "goes on from here" in capsys.readouterr().err
    assert outcomes(tmp_path) == ["ok", "ok"]
    monkeypatch.setattr(runner, "measure", measure)
    assert run.main(command) == 0
    assert len(asked) == len(list(GROUPS["renderer"].cases()))
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
    assert f"stopped by {name}; the same command goes on from here" in capsys.readouterr().err
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


def test_processors_of_one_name_but_other_vectors_have_files_of_their_own(
    workers, tmp_path, monkeypatch
):
    command = ["--only", "clips", "--output-dir", str(tmp_path)]
    for vectors in ("AVX-512", "AVX2", ""):
        monkeypatch.setitem(MACHINE, "vectors", vectors)
        assert run.main(command) == 0
    assert len(workers[0]) == 3
    assert {file.name for file in tmp_path.glob("*.json")} == {
        "cpu-avx512.json",
        "cpu-avx2.json",
        "cpu.json",
    }
    assert "a processor with AVX-512," in (tmp_path / "cpu-avx512.md").read_text()
    assert "a processor, 2 cores" in page_of(tmp_path)


def test_vectors_of_a_gpu_s_host_do_not_matter(workers, tmp_path, monkeypatch):
    monkeypatch.setitem(MACHINE, "platform", "gpu")
    monkeypatch.setitem(MACHINE, "vectors", "AVX2")
    assert run.main(["--only", "clips", "--output-dir", str(tmp_path)]) == 0
    assert (tmp_path / "gpu.json").exists()


def test_results_from_before_vectors_were_noted_are_shown(workers, tmp_path, monkeypatch):
    command = ["--only", "clips", "--output-dir", str(tmp_path)]
    assert run.main(command) == 0
    kept = json.loads((tmp_path / "cpu.json").read_text())
    for machine in kept["machines"].values():
        del machine["vectors"]
    (tmp_path / "cpu.json").write_text(json.dumps(kept))
    monkeypatch.setitem(MACHINE, "processor", "another processor")
    assert run.main([*command, "--only", "devices"]) == 0
    assert "a processor, 2 cores" in page_of(tmp_path)


@pytest.mark.skipif(os.name != "posix", reason="signals are those of POSIX")
def test_a_benchmark_that_is_stopped_leaves_no_process_behind(tmp_path):
    command = [sys.executable, "-m", "pixelbrax_jax.cli", "bench", "--output-dir", str(tmp_path)]
    stopped = subprocess.Popen(command, cwd=ROOT)
    parent = psutil.Process(stopped.pid)
    while not (left := parent.children(recursive=True)):
        assert stopped.poll() is None
        time.sleep(0.1)
    time.sleep(3.0)  # until it knows what to do when it is told to stop
    left = parent.children(recursive=True)
    stopped.terminate()
    assert stopped.wait(30.0) != 0
    assert not psutil.wait_procs(left, timeout=30.0)[1]


def test_a_file_of_another_kind_is_not_touched(workers, tmp_path, capsys):
    (tmp_path / "cpu.json").write_text('{"environment": []}')
    assert run.main(["--only", "renderer", "--output-dir", str(tmp_path)]) == 1
    assert "not a result of this benchmark" in capsys.readouterr().err
    assert (tmp_path / "cpu.json").read_text() == '{"environment": []}'


def test_a_misspelt_task_is_refused(workers, capsys):
    with pytest.raises(SystemExit):
        run.main(["--task", "antt"])
    assert "antt" in capsys.readouterr().err


def test_the_page_has_every_table_and_right_ratios(workers, tmp_path, monkeypatch):
    monkeypatch.setattr(all_cases, "peer_python", lambda peer: "python")
    assert run.main(["--peers", "--output-dir", str(tmp_path)]) == 0
    page = page_of(tmp_path)
    for group in GROUPS:
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
    answers["throughput.renderer"] = MemoryError("RESOURCE_EXHAUSTED: 9 GB")
    assert run.main(["--only", "renderer", "--output-dir", str(tmp_path)]) == 0
    assert set(outcomes(tmp_path)) == {"out of memory"}
    assert len(outcomes(tmp_path)) == len(asked) > 1
    assert "RESOURCE_EXHAUSTED: 9 GB" in page_of(tmp_path)


def test_a_failure_is_recorded_and_told(workers, tmp_path):
    _, answers = workers
    answers["throughput.renderer"] = RuntimeError("something else")
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
    ("script", "error", "why"),
    [
        ("raise MemoryError('no room')", MemoryError, "no room"),
        (JAX_ERROR, MemoryError, "no room for 9 GB"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", runner.KilledError, "killed"),
        ("raise ValueError('wrong')", RuntimeError, "ValueError: wrong"),
        ("import sys; sys.stderr.write('no OpenGL'); sys.exit(3)", AbsentError, "no OpenGL"),
        ("print('no result')", RuntimeError, "no result"),
    ],
    ids=["memory", "JAX's memory", "killed", "error", "absent", "no result"],
)
def test_how_a_process_ends_is_understood(tmp_path, script, error, why):
    (tmp_path / "script.py").write_text(script)
    with pytest.raises(error, match=why):
        runner.process([sys.executable, str(tmp_path / "script.py")], {}, 60.0)


def test_what_takes_too_long_leaves_no_process(tmp_path):
    python = tmp_path / "python"
    python.write_text(f"#!/bin/sh\nsleep 300 & echo $! > {tmp_path}/child\nwait\n")
    python.chmod(0o755)
    with pytest.raises(subprocess.TimeoutExpired):
        runner.process([str(python)], {}, 1.0)
    child = int((tmp_path / "child").read_text())
    for _ in range(100):
        state = Path(f"/proc/{child}/stat")
        if not state.exists() or state.read_text().split()[2] == "Z":
            return
        time.sleep(0.05)
    pytest.fail("the child lives")


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
        ("bank.load", {"size": 16, "frames": 2}),
        (
            "scaling.training",
            {"task": "inverted_pendulum", "num_devices": 2, "cores": 1, "num_envs": 4},
        ),
    ],
)
def test_more_real_cases_run(measure, options):
    ours = measure.split(".")[0] in ("throughput", "adapters", "distractors")
    package = "pixelbrax_gym.bench" if ours else "tests.benchmarks"
    kind = all_cases.DevicesCase if "num_devices" in options else Case
    outcome = runner.measure(kind("adapters", measure, options, package), 900.0)
    assert outcome["status"] == "ok", outcome


def test_cases_have_names_of_their_own():
    keys = [case.key for group in GROUPS.values() for case in group.cases()]
    assert len(set(keys)) == len(keys)
    asked = {
        (case.arguments["task"], case.arguments["num_envs"])
        for case in cases.environments()
        if case.arguments.get("obs_mode") == "pixels"
    }
    assert asked == {(task, n) for task in cases.TASKS for n in (1, 10, 100, 1000, 4096, 8192)}


def test_the_command_measures_this_machine_and_shows_the_page(workers, tmp_path, capsys):
    asked, _ = workers
    assert command.main(["--output-dir", str(tmp_path)]) == 0
    assert {measure.split(".")[0] for measure, _, _ in asked} == {"throughput", "adapters"}
    shown = capsys.readouterr().out
    assert (tmp_path / "cpu.md").read_text() in shown
    assert str(tmp_path / "cpu.png") in shown
    count = len(asked)
    assert command.main(["--output-dir", str(tmp_path)]) == 0
    assert len(asked) == count
    assert command.main(["--full", "--only", "distractors", "--output-dir", str(tmp_path)]) == 0
    assert len(asked) == count + len(list(cases.distractors()))


def test_without_matplotlib_the_command_says_how_to_get_a_plot(
    workers, tmp_path, capsys, monkeypatch
):
    for module in (command, report):
        monkeypatch.setattr(module, "find_spec", lambda name: None)
    assert command.main(["--output-dir", str(tmp_path)]) == 0
    assert 'pip install "pixelbrax[demo]"' in capsys.readouterr().out
    assert not (tmp_path / "cpu.png").exists()


def test_a_part_that_only_the_full_benchmark_has_is_named(workers, capsys):
    with pytest.raises(SystemExit):
        command.main(["--only", "distractors"])
    assert "--full" in capsys.readouterr().err


def test_options_that_leave_nothing_are_told(workers, capsys):
    assert command.main(["--task", "humanoid"]) == 1
    assert "no case fits" in capsys.readouterr().err


def test_adapters_that_are_not_installed_are_left_out(monkeypatch):
    made = []
    monkeypatch.setattr(adapters, "find_spec", lambda name: None)
    monkeypatch.setattr(adapters.pb, "make", lambda task: [SimpleNamespace(action_size=1)])
    for name in ("scan", "_gymnasium"):
        monkeypatch.setattr(adapters, name, lambda *given: made.append(given) or (lambda: None))
    loops = {("JAX loop", "next_step"): lambda: None}
    monkeypatch.setattr(adapters, "_jax_loops", lambda *given: loops)
    found = adapters.compare("ant", 64, seconds=0.0)
    assert [row["adapter"] for row in found] == [
        "JAX scan",
        "JAX loop",
        "Gymnasium, jax",
        "Gymnasium, numpy",
    ]
    assert len(made) == 3
