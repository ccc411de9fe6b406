"""Environments that are pickled or copied go on as the original does, to the bit."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from functools import partial

import cloudpickle
import gymnasium
import jax
import numpy as np
import pytest
import torch

import pixelbrax_jax
from tests.gym.adapters import ADAPTERS, Single, Vector, as_bytes

COPIES = {
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
    "cloudpickle": lambda env: cloudpickle.loads(cloudpickle.dumps(env)),
    "deepcopy": copy.deepcopy,
}
DISTRACTED = {"distractors": "color", "episode_length": 6}
ENVS = {name: partial(make, **DISTRACTED) for name, make in ADAPTERS.items()} | {
    "window": lambda: Single(render_mode="human", render_height=8, render_width=8, **DISTRACTED)
}


def some_calls(adapter, count):
    """The bits of everything that an environment returns in some steps and resets."""
    return [as_bytes(adapter.call()[1]) for _ in range(count)]


def started(name):
    adapter = ENVS[name]()
    adapter.reset(seed=3)
    return adapter


def copied(adapter, how=copy.deepcopy):
    other = copy.copy(adapter)
    other.env = how(adapter.env)
    return other


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("name", ENVS)
def test_a_copy_goes_on_as_the_original_does(name, how):
    adapter = started(name)
    some_calls(adapter, 3)
    other = copied(adapter, COPIES[how])
    # The one that goes on first must not change the other.
    expected = some_calls(adapter, 9)
    assert some_calls(other, 9) == expected
    adapter.env.close(), other.env.close()


def test_a_copy_before_the_first_reset():
    adapter = ENVS["numpy"]()
    other = copied(adapter, COPIES["pickle"])
    assert as_bytes(other.reset(seed=1)) == as_bytes(adapter.reset(seed=1))


def test_a_deep_copy_shares_what_nothing_writes_to():
    adapter = started("numpy")
    other = copied(adapter)
    one, two = adapter.env._stateful, other.env._stateful
    assert two.params is one.params
    assert two._programs is one._programs
    assert two._snapshot.packed is one._snapshot.packed
    # Both are the next to write, and neither into what the other reads.
    frames = one._snapshot.packed.frames
    some_calls(adapter, 4), some_calls(other, 4)
    assert not frames.is_deleted()


def test_a_deep_copy_is_not_reached_by_what_torch_writes():
    adapter, clean = started("torchrl"), started("torchrl")
    while not adapter.ended.any():
        adapter.call(), clean.call()
    twin = copied(adapter)
    (_, wanted), (_, spoiled) = clean.call(), adapter.call()
    spoiled["pixels"].zero_()
    _, after = twin.call()
    assert torch.equal(after["pixels"], wanted["pixels"])
    assert after["pixels"].any()


def test_clips_are_on_the_device_once_and_after_a_pickle_too():
    options = {"distractors": "video", "clips": "procedural"}
    adapters = [Vector(**options) for _ in range(2)]
    packed = [adapter.env._stateful.params.clips.packed for adapter in adapters]
    assert packed[0].unsafe_buffer_pointer() == packed[1].unsafe_buffer_pointer()
    adapters[0].reset(seed=0)
    restored = copied(adapters[0], COPIES["pickle"])
    expected = some_calls(adapters[0], 3)
    assert some_calls(restored, 3) == expected
    assert all(isinstance(x, jax.Array) for x in jax.tree.leaves(restored.env._stateful.params))


@pytest.mark.parametrize("task", ["inverted_pendulum", "dmc_cartpole_swingup"])
def test_equal_environments_after_a_pickle(task):
    env, params = pixelbrax_jax.make(task, height=12, width=12, distractors=("color", "camera"))
    for one in (env, pixelbrax_jax.VectorPixelEnv(env, 4), env.physics):
        data = pickle.dumps(one)
        # Not its model: how it is made.
        assert len(data) < 2000
        assert pickle.loads(data) == one
        assert copy.deepcopy(one) == one
    restored = pickle.loads(pickle.dumps(params))
    jax.tree.map(np.testing.assert_array_equal, restored, params)


@pytest.mark.slow
def test_another_process_goes_on(tmp_path):
    env = gymnasium.make_vec(
        "PixelBrax/InvertedPendulum-v0", num_envs=2, height=12, width=12, obs_mode="both"
    )
    env.reset(seed=0)
    action = np.full((2, 1), 0.3, np.float32)
    env.step(action)
    (tmp_path / "env").write_bytes(pickle.dumps(env))
    code = (
        "import pickle, pathlib, numpy as np\n"
        f"folder = pathlib.Path({str(tmp_path)!r})\n"
        "env = pickle.loads((folder / 'env').read_bytes())\n"
        "obs = [env.step(np.full((2, 1), 0.3, np.float32))[0] for _ in range(3)][-1]\n"
        "np.savez(folder / 'obs.npz', **obs)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    wanted = [env.step(action)[0] for _ in range(3)][-1]
    with np.load(tmp_path / "obs.npz") as seen:
        for name, value in wanted.items():
            np.testing.assert_array_equal(seen[name], value)


def faster(before, after, action):
    return after.qd[0] - before.qd[0]


def test_physics_of_your_own():
    from pixelbrax_jax.physics.brax.loading import load_brax_env

    physics = pixelbrax_jax.BraxPhysics(load_brax_env("inverted_pendulum", "spring"), reward=faster)
    other = pickle.loads(pickle.dumps(physics))
    assert other == physics
    assert copy.deepcopy(physics) is physics
    state, same = (jax.jit(p.reset)(jax.random.key(0)) for p in (physics, other))
    action = np.full(1, 0.5, np.float32)
    after, wanted = jax.jit(other.step)(same, action), jax.jit(physics.step)(state, action)
    np.testing.assert_array_equal(after.obs, wanted.obs)
    assert after.reward == wanted.reward != 0
