"""The doctor's findings, from invented machines and from this one."""

from __future__ import annotations

from dataclasses import replace
from importlib.metadata import version

import pytest

from pixelbrax_gym import cli, doctor

HEALTHY = doctor.Machine(
    versions=dict.fromkeys(("jax", *doctor.EXTRAS.values()), "1.0"),
    missing={},
    jax_device="cuda:0",
    jax_platform="gpu",
    jax_error=None,
    has_nvidia=True,
    torch_cuda=True,
    to_torch=True,
    to_jax=True,
    renderer=("pallas", "by one kernel, on NVIDIA H100"),
    environ={"XLA_CLIENT_MEM_FRACTION": "0.4"},
    broken={},
    cache="",
)


def not_ok(**changes):
    return [f for f in doctor.diagnose(replace(HEALTHY, **changes)) if f.level != "ok"]


def test_a_healthy_machine():
    findings = doctor.diagnose(HEALTHY)
    assert {finding.level for finding in findings} == {"ok"}
    text = doctor.report(findings)
    assert "JAX and torch see the same device" in text
    assert "JAX to torch without a copy" in text
    assert text.endswith("No problems found.")


@pytest.mark.parametrize(
    ("changes", "level", "text", "fix"),
    [
        (
            {"jax_platform": "cpu", "jax_device": "cpu:0", "torch_cuda": False},
            "problem",
            "NVIDIA GPU, but JAX does not use it",
            "pixelbrax[cuda12]",
        ),
        (
            {"jax_platform": "cpu", "has_nvidia": False},
            "problem",
            "torch uses CUDA but JAX uses the CPU",
            "pixelbrax[cuda12]",
        ),
        ({"torch_cuda": False}, "problem", "JAX uses the GPU but torch cannot", "torch built for"),
        (
            {"jax_error": "RuntimeError: no backend", "to_torch": None, "to_jax": None},
            "problem",
            "JAX finds no device to compute on: RuntimeError: no backend",
            "JAX_PLATFORMS",
        ),
        (
            {"torch_cuda": "ImportError: libcudart", "to_torch": None, "to_jax": None},
            "problem",
            "torch is installed but cannot be imported: ImportError: libcudart",
            "reinstall it",
        ),
        (
            {
                "jax_platform": "tpu",
                "torch_cuda": False,
                "has_nvidia": False,
                "to_torch": None,
                "to_jax": None,
            },
            "note",
            "cannot share the memory of a tpu",
            "output='numpy'",
        ),
        ({"to_torch": False}, "problem", "arrays are copied from JAX to torch", "constraints"),
        ({"to_jax": "BufferError: x"}, "problem", "from torch to JAX: BufferError: x", "numpy"),
        ({"environ": {}}, "note", "75% of the GPU's memory", "XLA_CLIENT_MEM_FRACTION=0.4"),
        (
            {
                "environ": {
                    "XLA_CLIENT_MEM_FRACTION": "0.4",
                    "XLA_PYTHON_CLIENT_MEM_FRACTION": "0.4",
                }
            },
            "problem",
            "are both set",
            "unset XLA_PYTHON_CLIENT_MEM_FRACTION",
        ),
        (
            {
                "jax_error": "AssertionError: ",
                "environ": HEALTHY.environ | {"JAX_PLATFORMS": "cuda"},
                "to_torch": None,
                "to_jax": None,
            },
            "problem",
            "no device to compute on: AssertionError:  (JAX_PLATFORMS=cuda)",
            "unset JAX_PLATFORMS",
        ),
        (
            {"jax_error": "RuntimeError: flag", "broken": {"XLA_FLAGS": "Unknown flag"}},
            "problem",
            "JAX cannot start: Unknown flag",
            "unset XLA_FLAGS",
        ),
        (
            {"broken": {"MUJOCO_GL": "no glGetError"}},
            "note",
            "MuJoCo's own renderer cannot start; PixelBrax does not use it: no glGetError",
            "unset MUJOCO_GL",
        ),
        ({"cache": "/home cannot be written"}, "note", "reads them again", "PIXELBRAX_CACHE"),
        (
            {"missing": {"torchrl": ["torchrl"], "train": ["flatbuffers", "psutil"]}},
            "note",
            "extras: torchrl lacks torchrl; train lacks flatbuffers, psutil",
            "pixelbrax[torchrl,train]",
        ),
    ],
)
def test_each_problem_has_a_fix(changes, level, text, fix):
    (finding,) = not_ok(**changes)
    assert finding.level == level
    assert text in finding.text
    assert fix in finding.fix


@pytest.mark.parametrize(
    "environ",
    [
        {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"},
        {"XLA_PYTHON_CLIENT_ALLOCATOR": "Platform"},
        {"XLA_CLIENT_MEM_FRACTION": "", "XLA_PYTHON_CLIENT_PREALLOCATE": "0"},
        {"XLA_CLIENT_MEM_FRACTION": ".3"},
    ],
)
def test_memory_may_be_left_to_others(environ):
    assert not not_ok(environ=environ)


def test_a_cpu_alone_is_fine():
    cpu = {
        "jax_platform": "cpu",
        "jax_device": "cpu:0",
        "has_nvidia": False,
        "torch_cuda": False,
        "environ": {},
    }
    assert not not_ok(**cpu)
    assert not not_ok(**cpu, to_torch=None, to_jax=None)


def test_problems_are_counted():
    text = doctor.report(doctor.diagnose(replace(HEALTHY, to_torch=False, to_jax=False)))
    assert text.endswith("2 problems found.")
    assert " -> install current versions of torch" in text


def test_this_machine():
    machine = doctor.inspect()
    assert machine.versions["jax"] == version("jax")
    assert machine.to_torch is True
    assert machine.to_jax is True


def test_variables_that_other_tools_leave(monkeypatch):
    values = {
        "XLA_FLAGS": ("--xla_nonsense=1", "Unknown flag in XLA_FLAGS: --xla_nonsense=1"),
        "MUJOCO_GL": ("garbage", "invalid value for environment variable MUJOCO_GL: garbage"),
        "IMAGEIO_FFMPEG_EXE": ("/nowhere/ffmpeg", "'/nowhere/ffmpeg', which is not a program"),
        "SDL_VIDEODRIVER": ("garbage", "garbage not available"),
        "MPLBACKEND": ("garbage", "'garbage' is not a valid value"),
    }
    assert set(values) == set(doctor.VARIABLES)
    for name, (value, _) in values.items():
        monkeypatch.setenv(name, value)
    broken = doctor.broken_variables()
    for name, (_, why) in values.items():
        assert why in broken[name]
        monkeypatch.delenv(name)
    assert doctor.broken_variables() == {}


def test_a_variable_is_not_blamed_for_another(monkeypatch):
    def broken(code):
        variable = doctor._Variable("jax", f"import os, sys, time\n{code}", "problem", "")
        monkeypatch.setattr(doctor, "VARIABLES", {"XLA_FLAGS": variable})
        return doctor.broken_variables()

    # JAX_PLATFORMS names what is not there, and the flags are fine.
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    assert broken("sys.exit('no such platform')") == {}
    assert broken("sys.exit('flag' if 'XLA_FLAGS' in os.environ else 0)") == {"XLA_FLAGS": "flag"}
    # Both are wrong, and XLA would end the process because of the flags.
    both = "sys.exit('flag' if 'XLA_FLAGS' in os.environ else 'no such platform')"
    assert broken(both) == {"XLA_FLAGS": "flag"}
    monkeypatch.setattr(doctor, "_PATIENCE", 1.0)
    hangs = "time.sleep(60 * ('XLA_FLAGS' in os.environ))"
    assert broken(hangs) == {"XLA_FLAGS": "timeout after 1 s"}


def test_a_cache_that_cannot_be_written(monkeypatch, tmp_path):
    monkeypatch.setenv("PIXELBRAX_CACHE", str(tmp_path / "made" / "later"))
    assert doctor.why_no_cache() == ""
    (tmp_path / "file").touch()
    monkeypatch.setenv("PIXELBRAX_CACHE", str(tmp_path / "file"))
    assert doctor.why_no_cache() == f"{tmp_path / 'file'} is no folder"
    monkeypatch.delenv("PIXELBRAX_CACHE")
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.setattr("pwd.getpwuid", lambda uid: {}[uid])
    assert "set HOME, or PIXELBRAX_CACHE" in doctor.why_no_cache()


@pytest.mark.parametrize(("broken", "status"), [(False, 0), (True, 1)])
def test_command(monkeypatch, capsys, broken, status):
    machine = replace(HEALTHY, to_torch=not broken)
    monkeypatch.setattr(doctor, "inspect", lambda: machine)
    assert cli.main(["doctor"]) == status
    assert ("1 problem found." if broken else "No problems found.") in capsys.readouterr().out
