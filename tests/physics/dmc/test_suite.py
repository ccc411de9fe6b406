"""DM Control's environments start in our states."""

from __future__ import annotations

import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from pixelbrax_jax.physics.dmc.suite import SuiteEnv
from pixelbrax_jax.tasks import DMC_TASKS
from tests.opengl import need_opengl
from tests.physics.dmc import oracle

pytestmark = pytest.mark.usefixtures("dm_control")


def started(task: str, **options):
    """DM Control's environment in an initial state of its own, and ours started in that state."""
    theirs, env = oracle.load(task, seed=1), SuiteEnv(task, **options)
    seen = oracle.record(theirs, theirs.reset())
    env.start(SimpleNamespace(engine=SimpleNamespace(**seen)))
    return theirs, env, seen


@pytest.mark.parametrize("task", DMC_TASKS)
def test_an_episode_starts_and_goes_on_as_dm_controls_own(task):
    theirs, env, seen = started(task)
    # The solver starts elsewhere, and observations are rounded to float32.
    close = {"rtol": 1e-5, "atol": 1e-5}
    np.testing.assert_allclose(env.observe(), seen["obs"], **close)
    np.testing.assert_array_equal(env._physics.data.light_xpos, theirs.physics.data.light_xpos)
    spec = theirs.action_spec()
    low, high = spec.minimum, spec.maximum
    for action in np.random.default_rng(0).uniform(-1.1, 1.1, (3, *spec.shape)):
        reward = env.step(action)
        timestep = theirs.step(low + 0.5 * (np.clip(action, -1, 1) + 1) * (high - low))
        assert reward == pytest.approx(timestep.reward, abs=1e-6)
        np.testing.assert_allclose(env.observe(), oracle.flatten(timestep.observation), **close)


@pytest.mark.parametrize("task", ["dmc_swimmer_swimmer6", "dmc_quadruped_walk"])
def test_the_picture_is_dm_controls(task):
    need_opengl()
    theirs, env, _ = started(task, size=(24, 36))
    image = env.render()
    assert image.shape == (24, 36, 3)
    camera = 2 if "quadruped" in task else 0
    np.testing.assert_array_equal(image, theirs.physics.render(24, 36, camera_id=camera))
    env.close()


def test_samples_are_means_of_a_larger_picture():
    need_opengl()
    theirs, env, _ = started("dmc_cartpole_swingup", size=(24, 36), samples=9)
    large = theirs.physics.render(72, 108, camera_id=0).astype(float)
    rows = sum(large[i::3] for i in range(3))
    means = sum(rows[:, i::3] for i in range(3)) / 9
    np.testing.assert_array_equal(env.render(), np.floor(means + 0.5))
    env.close()


def test_a_camera_is_one_of_the_models():
    assert SuiteEnv("dmc_walker_walk", camera="back")._camera == 1
    with pytest.raises(ValueError, match=r"camera of 'walker': 'front'; allowed: back, side"):
        SuiteEnv("dmc_walker_walk", camera="front")
    with pytest.raises(ValueError, match="size=None means no pictures"):
        SuiteEnv("dmc_pendulum_swingup").render()


def test_a_missing_dm_control_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "dm_control", None)
    with pytest.raises(ImportError, match=r'dm_control cannot be .*pip install "pixelbrax\[dmc\]"'):
        SuiteEnv("dmc_pendulum_swingup")


def test_missing_opengl_is_told():
    code = (
        "import os, sys\n"
        "from pixelbrax_jax.physics.dmc.suite import SuiteEnv\n"
        "for value in ('garbage', 'disable', ''):\n"
        "    os.environ['MUJOCO_GL'] = value\n"
        "    if not value:\n"
        "        del os.environ['MUJOCO_GL']\n"
        "    try:\n"
        "        SuiteEnv('dmc_pendulum_swingup', size=(8, 8))\n"
        "    except ImportError as error:\n"
        "        print(error)\n"
    )
    environ = {k: v for k, v in os.environ.items() if "DISPLAY" not in k}
    done = subprocess.run([sys.executable, "-c", code], env=environ, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    garbage, disable, unset = done.stdout.splitlines()
    assert "MUJOCO_GL 'garbage': Environment variable MUJOCO_GL must be one of" in garbage
    assert "MUJOCO_GL 'disable': No OpenGL rendering backend is available." in disable
    if sys.platform == "linux":
        assert "MUJOCO_GL unset: there is no display. Set MUJOCO_GL=egl" in unset
