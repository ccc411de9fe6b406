"""The wheel holds what it should, and works in an environment that holds nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
import venv
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

PROGRAM = """
import sys
from importlib.metadata import version

import gymnasium
import pixelbrax_gym
import pixelbrax_jax

assert "site-packages" in pixelbrax_jax.__file__, pixelbrax_jax.__file__
assert "site-packages" in pixelbrax_gym.__file__, pixelbrax_gym.__file__
assert len(pixelbrax_jax.list_envs()) == 52
ids = [name for name in gymnasium.registry if name.startswith("PixelBrax/")]
assert len(ids) == 52, ids

options = dict(num_envs=2, height=8, width=12, frame_stack=1)
envs = gymnasium.make_vec("PixelBrax/InvertedPendulum-v0", **options)
envs.reset(seed=0)
obs, *_ = envs.step(envs.action_space.sample())
assert obs.shape == (2, 8, 12, 3) and obs.any()
try:
    gymnasium.make_vec("PixelBrax/InvertedPendulum-v0", output="torch", **options)
except ImportError as error:
    assert "pixelbrax[torch]" in str(error), error
else:
    raise SystemExit("torch is here: the environment is not empty")
print("works", version("pixelbrax"))
"""


OURS = ("PYTHONPATH", "VIRTUAL_ENV", "JAX_COMPILATION_CACHE_DIR", "XLA_FLAGS")
"""Variables of the tests' own environment."""


def run(*command: str | Path, cwd: Path) -> str:
    """Output of a command that knows nothing of the environment the tests run in."""
    environ = {k: v for k, v in os.environ.items() if k not in OURS}
    result = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=environ,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, f"{result.stdout}\n{result.stderr}"
    return result.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", out, ROOT, cwd=out)
    (path,) = out.glob("*.whl")
    return path


def test_the_wheel_holds_the_packages_and_nothing_else(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    info = f"pixelbrax-{wheel.name.split('-')[1]}.dist-info"
    assert {name.split("/")[0] for name in names} == {"pixelbrax_jax", "pixelbrax_gym", info}
    assert f"{info}/licenses/LICENSE" in names
    assert {"pixelbrax_jax/py.typed", "pixelbrax_gym/py.typed"} <= set(names)
    sources = {
        path.relative_to(ROOT).as_posix()
        for package in ("pixelbrax_jax", "pixelbrax_gym")
        for path in (ROOT / package).rglob("*.py")
    }
    assert sources <= set(names)


def test_the_metadata_says_what_a_user_needs(wheel):
    archive = zipfile.ZipFile(wheel)
    (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
    metadata = Parser().parsestr(archive.read(name).decode())
    assert metadata["Name"] == "pixelbrax"
    assert metadata["License-Expression"] == "Apache-2.0"
    assert metadata["Requires-Python"] == ">=3.11"
    extras = {
        "torch",
        "torchrl",
        "sb3",
        "dmc",
        "clips",
        "human",
        "video",
        "demo",
        "train",
        "dataset",
    }
    extras |= {"cuda12", "cuda13", "warp"}
    extras |= {"all", "test", "dev", "docs"}
    assert set(metadata.get_all("Provides-Extra")) == extras
    # What is heavy or needs a display is never installed unasked.
    core = [line for line in metadata.get_all("Requires-Dist") if "extra ==" not in line]
    assert not [line for line in core if line.startswith(("torch", "pygame", "matplotlib"))]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_wheel_works_in_an_empty_environment(wheel, tmp_path):
    venv.create(tmp_path / "env", with_pip=True)
    (python,) = (tmp_path / "env").glob("*/python")
    pip = (python, "-m", "pip", "--disable-pip-version-check")
    run(*pip, "install", "--quiet", "-c", ROOT / "constraints.txt", wheel, cwd=tmp_path)
    installed = run(*pip, "list", "--format=freeze", cwd=tmp_path).lower()
    assert "\ntorch==" not in installed

    empty = tmp_path / "empty"
    empty.mkdir()
    output = run(python, "-W", "error", "-c", PROGRAM, cwd=empty)
    assert output.strip().endswith(f"works {wheel.name.split('-')[1]}")


COMMANDS = (
    "doctor",
    "bench --task inverted_pendulum --num-envs 2 --output bench.json",
    "play inverted_pendulum --gif pendulum.gif --num-frames 4 --size 64",
    "train ppo --preset ci --total-steps 20000 --output-dir run",
    "evaluate run --episodes 2",
    "record run --num-frames 8 --grid 2 --size 64",
)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_every_command_works_outside_of_a_clone(wheel, tmp_path):
    venv.create(tmp_path / "env", with_pip=True)
    (python,) = (tmp_path / "env").glob("*/python")
    extras = f"{wheel}[train,video]"
    run(python, "-m", "pip", "install", "-q", "-c", ROOT / "constraints.txt", extras, cwd=tmp_path)
    where = tmp_path / "empty"
    where.mkdir()
    for command in COMMANDS:
        run(python.parent / "pixelbrax", *command.split(), cwd=where)
    written = ("bench.json", "pendulum.gif", "run/videos/*.mp4")
    assert all(list(where.glob(name)) for name in written)
