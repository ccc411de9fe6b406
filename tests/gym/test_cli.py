"""What all commands have in common: names, help, errors, warnings, exit statuses."""

from __future__ import annotations

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
