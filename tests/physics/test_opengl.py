"""No OpenGL is loaded, whatever ``MUJOCO_GL`` says, and MuJoCo's own renderer works as before."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

BEFORE = """
import os
before = dict(os.environ)
"""
FILE = Path(__file__).parents[2] / "pixelbrax_jax" / "physics" / "mujoco" / "opengl.py"
# The file by itself, as its package imports JAX.
MUJOCO = f"import runpy\nrunpy.run_path({str(FILE)!r})['import_mujoco']()\n"
PHYSICS = "import pixelbrax_jax.physics\n"
MAKE = "pixelbrax_jax.make('inverted_pendulum', height=8, width=8)\n"
LOOK = """
assert dict(os.environ) == before, "the environment is as it was"
maps = open("/proc/self/maps").read()
for name in ("libGL.", "libEGL", "libOSMesa", "libGLX", "libglfw"):
    assert name not in maps, name
"""
ALONE = """
try:
    import mujoco
    print(mujoco.GLContext.__module__)
except Exception as error:
    print(f"{type(error).__name__}: {error}")
"""
"""What MuJoCo draws with."""


def output(code: str, value: str | None) -> str:
    environ = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    environ |= {} if value is None else {"MUJOCO_GL": value}
    result = subprocess.run(
        [sys.executable, "-c", code], env=environ, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.rstrip()


needs_linux = pytest.mark.skipif(sys.platform != "linux", reason="the names are those of Linux")


@needs_linux
@pytest.mark.parametrize("value", ["glfw", "osmesa"])
def test_the_users_own_renderer_is_loaded_late(value):
    # The same module, or the same error, as MuJoCo has by itself.
    assert output(BEFORE + MUJOCO + LOOK + ALONE, value) == output(ALONE, value)


@needs_linux
@pytest.mark.slow
@pytest.mark.parametrize("value", [None, "egl", "osmesa", "glfw", "garbage"])
def test_environments_are_made_without_opengl(value):
    made = MAKE if value == "osmesa" else ""
    assert output(BEFORE + PHYSICS + made + LOOK + ALONE, value) == output(ALONE, value)


def test_a_renderer_that_is_chosen_later():
    code = MUJOCO + "import os, mujoco.gl_context\n"
    code += "os.environ['MUJOCO_GL'] = 'garbage'\n"
    for place in ("mujoco", "mujoco.gl_context"):
        code += f"try: {place}.GLContext\nexcept RuntimeError as error: print(error)\n"
    code += "try: mujoco.absent\nexcept AttributeError as error: print(error)\n"
    code += "os.environ['MUJOCO_GL'] = 'disable'\nprint(hasattr(mujoco, 'GLContext'))"
    assert output(code, "egl").splitlines() == [
        *["invalid value for environment variable MUJOCO_GL: garbage"] * 2,
        "module 'mujoco' has no attribute 'absent'",
        "False",
    ]
