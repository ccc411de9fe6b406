"""OpenGL that draws without a window."""

import os

import pytest


def need_opengl() -> None:
    """Skip a test where ``MUJOCO_GL`` names no such OpenGL."""
    if os.environ.get("MUJOCO_GL") not in ("egl", "osmesa"):
        pytest.skip("MUJOCO_GL names no renderer without a window; egl and osmesa are such")
