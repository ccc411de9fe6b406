"""Environments that are pickled or copied go on as the original does, to the bit."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys

import cloudpickle
import gymnasium
import jax
import numpy as np
import pytest
import torch

import pixelbrax_gym
import pixelbrax_jax
from pixelbrax_jax.envs.sharded import make_env_mesh
from tests.gym.conftest import ID, SIZE, TASK

COPIES = {
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
    "cloudpickle": lambda env: cloudpickle.loads(cloudpickle.dumps(env)),
    "deepcopy": copy.deepcopy,
}
OPTIONS = SIZE | {"obs_mode": "both", "distractors": "color"}


def single(**options):
    env = gymnasium.make(ID, **(OPTIONS | options))
    env.reset(seed=3)
    return env


def vector(**options):
    env = gymnasium.make_vec(ID, num_envs=3, **(OPTIONS | options))
    env.reset(seed=3)
    return env


def sb3():
    env = pixelbrax_gym.SB3VecEnv(TASK, 3, **OPTIONS)
    env.seed(3)
    env.reset()
    return env


def torchrl():
    env = pixelbrax_gym.TorchRLEnv(TASK, 3, **OPTIONS)
    env.set_seed(3)
    env.reset()
    return env


ENVS = {
    "single": single,
    "window": lambda: single(render_mode="human", render_height=8, render_width=8),
    "numpy": vector,
    "torch": lambda: vector(output="torch", autoreset_mode="same_step"),
    "jax": lambda: vector(output="jax", autoreset_mode="disabled"),
    "sb3": sb3,
    "torchrl": torchrl,
}


def some_steps(env, count):
    """Everything that an environment returns in some steps and resets."""
    seen = []
    for i in range(count):
        if isinstance(env, gymnasium.Env):
            seen.append(env.step(np.full(1, 0.1 * i, np.float32)))
            if seen[-1][2] or seen[-1][3]:
                seen.append(env.reset())
        elif isinstance(env, pixelbrax_gym.TorchRLEnv):
            began = torch.tensor(env._begun[1])[:, None]
            if began.any():
                tensors = env.reset(env.full_done_spec.zero().set("_reset", began))
            else:
                tensors = env.step(
                    env.full_done_spec.zero().set("action", torch.full((3, 1), 0.1 * i))
                )["next"]
            seen.append({name: tensors[name] for name in ("pixels", "observation", "done")})
        else:
            done = env._stateful._snapshot.done
            if env._stateful._must_reset and np.any(done):
                seen.append(env.reset(options={"reset_mask": np.asarray(done)}))
            seen.append(env.step(np.full((3, 1), 0.1 * i, np.float32)))
    as_array = lambda x: x.numpy() if isinstance(x, torch.Tensor) else np.asarray(x)  # noqa: E731
    return jax.tree.map(lambda x: as_array(x).tobytes(), seen)


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("name", ENVS)
def test_a_copy_goes_on_as_the_original_does(name, how):
    env = ENVS[name]()
    some_steps(env, 3)
    other = COPIES[how](env)
    # The one that goes on first must not change the other.
    expected = some_steps(env, 9)
    assert some_steps(other, 9) == expected
    env.close(), other.close()


def test_a_copy_before_the_first_reset():
    env = gymnasium.make_vec(ID, num_envs=3, **OPTIONS)
    other = pickle.loads(pickle.dumps(env))
    obs, wanted = other.reset(seed=1)[0], env.reset(seed=1)[0]
    jax.tree.map(np.testing.assert_array_equal, obs, wanted)


def test_a_deep_copy_shares_what_nothing_writes_to():
    env = vector()
    other = copy.deepcopy(env)
    assert other._stateful.params is env._stateful.params
    assert other._stateful._programs is env._stateful._programs
    assert other._stateful._snapshot.packed is env._stateful._snapshot.packed
    # Both are the next to write, and neither into what the other reads.
    frames = env._stateful._snapshot.packed.frames
    some_steps(env, 4), some_steps(other, 4)
    assert not frames.is_deleted()


def test_a_deep_copy_is_not_reached_by_what_torch_writes():
    env, clean = torchrl(), torchrl()
    while not env._begun[1].any():
        some_steps(env, 1), some_steps(clean, 1)
    twin = copy.deepcopy(env)
    began = torch.tensor(env._begun[1])[:, None]
    first = [e.reset(e.full_done_spec.zero().set("_reset", began)) for e in (clean, env)]
    first[1]["pixels"].zero_()
    after = twin.reset(twin.full_done_spec.zero().set("_reset", began))
    assert torch.equal(after["pixels"], first[0]["pixels"])
    assert after["pixels"].any()


def test_clips_are_on_the_device_once_and_after_a_pickle_too():
    options = {"height": 12, "width": 12, "distractors": "video", "clips": "procedural"}
    envs = [gymnasium.make_vec(ID, num_envs=3, **options) for _ in range(2)]
    packed = [env._stateful.params.clips.packed for env in envs]
    assert packed[0].unsafe_buffer_pointer() == packed[1].unsafe_buffer_pointer()
    envs[0].reset(seed=0)
    restored = pickle.loads(pickle.dumps(envs[0]))
    expected = some_steps(envs[0], 3)
    assert some_steps(restored, 3) == expected
    assert all(isinstance(x, jax.Array) for x in jax.tree.leaves(restored._stateful.params))


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


def test_environments_spread_over_devices():
    env, _ = pixelbrax_jax.make("inverted_pendulum", height=12, width=12)
    sharded = pixelbrax_jax.ShardedVectorEnv(env, 4, make_env_mesh(1))
    assert pickle.loads(pickle.dumps(sharded)) == sharded
    assert copy.deepcopy(sharded) == sharded
    with pytest.raises(ValueError, match=r"need devices \[7\], which this process has not"):
        sharded.__setstate__(sharded.__getstate__() | {"mesh": [0, 7]})


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
