"""What all commands have in common: names, help, errors, warnings, exit statuses."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from importlib.metadata import version
from types import ModuleType

import pytest

from pixelbrax_gym import cli

COMMANDS = cli.commands()


@pytest.fixture
def command(monkeypatch):
    """Adds a command for a test: ``tell``, which does what it is given."""
    module = ModuleType("pixelbrax_gym.cli.tell")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(cli, "commands", lambda: ["tell"])
    return lambda run: setattr(module, "run", lambda arguments: run())


def test_every_command_is_listed(capsys):
    assert cli.main(["--help"]) == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines() if line[:2] == "  "]
    assert listed == COMMANDS
    assert {"doctor", "play", "train"} <= set(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_and_refuses_what_it_does_not_know(name, capsys):
    first = {"play": ["ant"], "clips": ["procedural"], "train": ["ppo"]}.get(name, [])
    with pytest.raises(SystemExit) as end:
        cli.main([name, *first, "--help"])
    assert end.value.code == 0
    assert f"usage: pixelbrax {name}" in capsys.readouterr().out
    with pytest.raises(SystemExit) as end:
        cli.main([name, *first, "--no-such-option"])
    assert end.value.code == 2
    assert "--no-such-option" in capsys.readouterr().err


def test_an_unknown_command_lists_the_known(capsys):
    assert cli.main(["docter"]) == 2
    assert "Did you mean 'doctor'?" in capsys.readouterr().err
    assert cli.main([]) == 2
    assert "name a command" in capsys.readouterr().err


def test_help_and_tasks_start_without_jax():
    code = "import sys; from pixelbrax_gym.cli import main; main(sys.argv[1:]); "
    for name in ("--help", "tasks", "--version"):
        command = [sys.executable, "-c", f"{code}assert 'jax' not in sys.modules", name]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == version("pixelbrax")


@pytest.mark.parametrize(
    ("error", "status"),
    [(OSError("disk"), 1), (cli.UsageError("both"), 2), (KeyboardInterrupt(), 130)],
)
def test_an_error_is_one_line_and_a_status(error, status, command, capsys):
    def run():
        raise error

    command(run)
    assert cli.main(["tell"]) == status
    told = f"pixelbrax tell: {error}\n" if str(error) else ""
    assert capsys.readouterr().err == told


def test_a_warning_is_one_line_without_source(command, capsys):
    command(lambda: warnings.warn("odd", stacklevel=2) or 0)
    assert cli.main(["tell"]) == 0
    assert capsys.readouterr().err == "pixelbrax tell: odd\n"


def test_a_reader_that_has_gone_is_no_error():
    line = f"{sys.executable} -m pixelbrax_gym.cli tasks | head -0; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=True)
    assert done.stdout.strip() in ("0", "1")
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_programs_are_kept_by_default_and_it_is_said_once(tmp_path):
    """In a home folder of its own: the folder, the line, and how to keep none."""
    code = "import sys; from pixelbrax_gym.cli import main; sys.exit(main(sys.argv[1:]))"
    play = ["play", "inverted_pendulum", "--gif", str(tmp_path / "a.gif")]
    play += ["--num-frames", "2", "--size", "16"]
    environ = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    environ |= {"PIXELBRAX_CACHE": str(tmp_path / "cache")}
    programs = tmp_path / "cache" / "programs"

    def said(*arguments):
        command = [sys.executable, "-W", "ignore", "-c", code, *arguments]
        done = subprocess.run(command, env=environ, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return "kept in" in done.stderr

    assert not said("--keep-no-programs", *play)
    assert not programs.exists()
    assert said(*play)
    kept = list(programs.rglob("*-cache"))
    assert kept
    assert not said(*play)
    assert sorted(programs.rglob("*-cache")) == sorted(kept)


def test_programs_of_a_library_are_kept_on_demand(tmp_path):
    code = "import pixelbrax_jax, jax; print(jax.config.jax_compilation_cache_dir)"
    environ = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    environ |= {"PIXELBRAX_CACHE": str(tmp_path)}
    for value, first in (("1", code), ("1", f"import jax; {code}"), ("0", code)):
        settings = environ | {"PIXELBRAX_KEEP_PROGRAMS": value}
        done = subprocess.run(
            [sys.executable, "-c", first], env=settings, capture_output=True, text=True, check=True
        )
        found = done.stdout.strip()
        assert found == "None" if value == "0" else found.startswith(str(tmp_path / "programs"))
