"""Forked workers say what is wrong; `tests/clients` has spawned ones, which work."""

from __future__ import annotations

import os

import gymnasium
import jax
import pytest

from tests.gym.conftest import ID, SIZE

pytestmark = pytest.mark.filterwarnings(
    # JAX and Python warn of the fork that these tests are about.
    "ignore:.*fork.*:RuntimeWarning",
    "ignore:.*fork.*:DeprecationWarning",
    # Gymnasium reports a worker's error as a warning too.
    "ignore::UserWarning",
)


@pytest.mark.timeout(120)
def test_forked_workers_name_the_cure():
    jax.devices()  # JAX runs before the fork
    makers = [lambda: gymnasium.make(ID, **SIZE)] * 2
    env = gymnasium.vector.AsyncVectorEnv(makers, context="fork", shared_memory=False)
    try:
        with pytest.raises(RuntimeError, match=r"PixelBrax was forked.*spawn.*make_vec"):
            env.reset(seed=0)
    finally:
        env.close(terminate=True)


def test_forked_workers_do_not_touch_clips():
    """They would be put on the device while the environment is made, where no error gets out."""
    options = SIZE | {"distractors": "video", "clips": "procedural"}
    gymnasium.make(ID, **options)  # known before the fork
    child, parent = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            gymnasium.make(ID, **options)
            message = "made"
        except RuntimeError as error:
            message = str(error)
        os.write(parent, message.encode())
        os._exit(0)
    os.waitpid(pid, 0)
    assert os.read(child, 10_000).decode().startswith("PixelBrax was forked")
    os.close(child), os.close(parent)
