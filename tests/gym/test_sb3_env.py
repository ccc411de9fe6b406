"""The Stable-Baselines3 adapter: its contract, its wrappers, its algorithms."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium import error
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.preprocessing import is_image_space_channels_first
from stable_baselines3.common.vec_env import (
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
    VecVideoRecorder,
)

import pixelbrax_gym
from tests.gym.conftest import TASK

RIGHT = np.array([[-0.2], [0.9], [1.0]], np.float32)
"""Ball 0 stays until the time limit; 1 and 2 leave the line, one before the other."""

STAY = np.zeros((3, 1), np.float32)


@pytest.mark.parametrize("obs_mode", ["pixels", "state", "both"])
@pytest.mark.parametrize("channels_first", [False, True])
def test_spaces_hold_what_comes(make_sb3, obs_mode, channels_first):
    env = make_sb3(obs_mode=obs_mode, channels_first=channels_first)
    for obs in (env.reset(), env.step(RIGHT)[0]):
        for i in range(3):
            row = {name: part[i] for name, part in obs.items()} if obs_mode == "both" else obs[i]
            assert env.observation_space.contains(row)
    pixels = obs["pixels"] if obs_mode == "both" else obs
    if obs_mode != "state":
        assert pixels.shape == ((3, 6, 12, 12) if channels_first else (3, 12, 12, 6))


def test_step_returns_what_stable_baselines_expects(make_sb3):
    env = make_sb3()
    env.reset()
    obs, rewards, dones, infos = env.step(RIGHT)
    assert isinstance(obs, np.ndarray)
    assert obs.flags.writeable
    assert (rewards.dtype, rewards.shape) == (np.float32, (3,))
    assert (dones.dtype, dones.shape) == (np.bool_, (3,))
    assert infos == [{"TimeLimit.truncated": False}] * 3


def test_channels_first_is_a_view_of_the_same_images(make_sb3):
    options = {"obs_mode": "both", "episode_length": 6}
    env, plain = make_sb3(channels_first=True, **options), make_sb3(**options)
    pairs = [(env.reset(), plain.reset())]
    for _ in range(8):
        (obs, _, dones, infos), (expected, *_, plain_infos) = env.step(RIGHT), plain.step(RIGHT)
        pairs.append((obs, expected))
        pairs += [
            tuple(each[i]["terminal_observation"] for each in (infos, plain_infos))
            for i in np.flatnonzero(dones)
        ]
    assert len(pairs) > 9
    for mine, other in pairs:
        np.testing.assert_array_equal(np.moveaxis(mine["pixels"], -3, -1), other["pixels"])
        np.testing.assert_array_equal(mine["state"], other["state"])
    assert infos[0]["TimeLimit.truncated"] is False


def test_a_terminal_observation_does_not_hold_the_batch(make_sb3):
    env = make_sb3(episode_length=1)
    env.reset()
    _, _, dones, infos = env.step(STAY)
    assert dones.all()
    assert infos[1]["terminal_observation"].base is None


def test_staggered_time_limits(make_sb3):
    env = make_sb3(stagger=True, episode_length=6)
    env.reset()
    lengths = [[], [], []]
    ends = []
    for step in range(1, 19):
        _, _, dones, infos = env.step(STAY)
        for i in np.flatnonzero(dones):
            assert infos[i]["TimeLimit.truncated"]
            lengths[i].append(infos[i]["episode_length"])
            ends.append((step, int(i)))
    # The limit is 6 steps: the first episodes last 6, 4 and 2.
    assert lengths == [[6, 6, 6], [4, 6, 6], [2, 6, 6]]
    assert len({step for step, _ in ends}) == len(ends)


def test_seeds(make_sb3):
    def first(env):
        return env.reset()[:, 0].tolist()

    options = {"obs_mode": "state"}
    one = first(make_sb3(seed=5, **options))
    assert first(make_sb3(seed=5, **options)) == one
    assert first(make_sb3(seed=6, **options))[:2] == one[1:]
    env = make_sb3(seed=5, **options)
    assert first(env) == one
    assert first(env) != one, "a seed serves one reset"
    assert env.seed(2**32 - 1) == [2**32 - 1, 0, 1]
    with pytest.raises(TypeError, match="must be an integer"):
        env.seed(1.5)
    np.random.seed(0)  # noqa: NPY002
    drawn = env.seed()
    np.random.seed(0)  # noqa: NPY002
    assert env.seed() == drawn


def test_sub_envs(make_sb3):
    env = make_sb3(render_mode="rgb_array", render_height=8, render_width=8)
    env.reset()
    assert env.get_attr("render_mode") == ["rgb_array"] * 3
    assert env.get_attr("index", [2, 0]) == [2, 0]
    env.set_attr("difficulty", 4, indices=1)
    assert env.get_attr("difficulty", 1) == [4]
    assert env.has_attr("index")
    assert not env.has_attr("difficulty")
    with pytest.raises(AttributeError):
        env.get_attr("difficulty")
    images = env.env_method("render", indices=[2, 0])
    assert images[0].shape == (8, 8, 3)
    np.testing.assert_array_equal(images, [env.get_images()[i] for i in (2, 0)])
    assert env.env_method("get_wrapper_attr", "index", indices=1) == [1]
    assert env.env_method("set_wrapper_attr", "level", 7, indices=[1]) == [True]
    assert env.env_method("has_wrapper_attr", "level") == [False, True, False]
    assert env.env_method("set_wrapper_attr", "other", 7, force=False) == [False] * 3
    assert env.env_is_wrapped(Monitor) == [False] * 3
    assert env.get_attr("unwrapped")[0].action_space == env.action_space


def test_render_tiles_all_environments(make_sb3):
    env = make_sb3(4, render_mode="rgb_array", render_height=8, render_width=10)
    env.reset()
    assert env.render().shape == (16, 20, 3)
    assert make_sb3().get_images() == [None] * 3


def test_monitor_agrees_with_our_statistics(make_sb3):
    env = VecMonitor(make_sb3())
    env.reset()
    seen = 0
    for _ in range(30):
        _, _, dones, infos = env.step(RIGHT)
        for i in np.flatnonzero(dones):
            seen += 1
            assert infos[i]["episode"]["l"] == infos[i]["episode_length"]
            assert infos[i]["episode"]["r"] == pytest.approx(infos[i]["episode_return"], abs=1e-5)
    assert seen


def test_frame_stack_and_normalize(make_sb3):
    env = VecNormalize(VecFrameStack(make_sb3(frame_stack=1, episode_length=6), 4), norm_obs=False)
    assert env.observation_space.shape == (12, 12, 12)
    assert env.reset().shape == (3, 12, 12, 12)
    for _ in range(8):
        _, _, dones, infos = env.step(RIGHT)
        for i in np.flatnonzero(dones):
            assert infos[i]["terminal_observation"].shape == (12, 12, 12)


# Moviepy forks FFmpeg at once, which is safe beside JAX's threads.
@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")
def test_video_recorder(make_sb3, tmp_path):
    env = make_sb3(render_mode="rgb_array", render_height=16, render_width=16)
    assert env.metadata["render_fps"] == 10
    env = VecVideoRecorder(env, str(tmp_path), record_video_trigger=lambda step: step == 0)
    env.reset()
    for _ in range(5):
        env.step(RIGHT)
    env.close()
    assert next(tmp_path.glob("*.mp4")).stat().st_size > 0


LARGE = {"height": 36, "width": 36, "episode_length": 6}  # the least that SB3's CNN takes
SMALL_NET = {"features_extractor_kwargs": {"features_dim": 16}, "net_arch": [8]}


def test_ppo_learns_saves_and_loads(make_sb3, tmp_path):
    env = VecMonitor(make_sb3(**LARGE))
    model = PPO("CnnPolicy", env, n_steps=8, batch_size=12, n_epochs=1, policy_kwargs=SMALL_NET)
    assert isinstance(model.get_env(), VecTransposeImage)
    model.learn(48)
    assert model.ep_info_buffer
    model.save(tmp_path / "agent")
    loaded = PPO.load(tmp_path / "agent", env=VecMonitor(make_sb3(**LARGE)))
    obs = env.reset()
    np.testing.assert_array_equal(
        loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0]
    )
    loaded.learn(24)
    returns, lengths = evaluate_policy(
        loaded, VecMonitor(make_sb3(**LARGE)), n_eval_episodes=4, return_episode_rewards=True
    )
    assert len(returns) == 4
    assert max(lengths) <= 6
    # An agent that was saved with three environments: SB3 refuses, unless it is loaded anew.
    with pytest.raises(AssertionError, match="number of environments"):
        loaded.set_env(make_sb3(2, **LARGE))
    PPO.load(tmp_path / "agent", env=make_sb3(2, **LARGE)).learn(16)


def test_ppo_takes_channels_first(make_sb3):
    env = make_sb3(channels_first=True, **LARGE)
    model = PPO("CnnPolicy", env, n_steps=4, batch_size=12, n_epochs=1, policy_kwargs=SMALL_NET)
    assert model.get_env() is env
    model.learn(12)


def test_use_out_of_order(make_sb3):
    env = make_sb3()
    with pytest.raises(error.ResetNeeded, match="reset"):
        env.step(STAY)
    env.set_options({"level": 1})
    with pytest.raises(ValueError, match=r"no options, got 'level'"):
        env.reset()
    env.reset()
    env.close()
    env.close()
    with pytest.raises(error.ClosedEnvironmentError, match="closed"):
        env.step(STAY)


def test_channels_first_space_is_an_image_to_gymnasium(make_sb3):
    space = make_sb3(channels_first=True).observation_space
    assert isinstance(space, gymnasium.spaces.Box)
    assert space == gymnasium.spaces.Box(0, 255, (6, 12, 12), np.uint8)


@pytest.mark.parametrize(
    ("size", "is_read"),
    [
        ({"height": 36, "width": 36, "frame_stack": 12}, False),
        ({"height": 12, "width": 40, "frame_stack": 5}, False),
        ({"height": 37, "width": 37, "frame_stack": 12}, True),
        ({"height": 40, "width": 20, "frame_stack": 12, "obs_mode": "state"}, True),
        ({"height": 36, "width": 36, "frame_stack": 12, "channels_first": True}, True),
        ({"height": 35, "width": 40, "frame_stack": 12, "channels_first": True}, False),
    ],
)
def test_images_are_read_as_they_are_or_refused(size, is_read):
    def make():
        return pixelbrax_gym.SB3VecEnv(TASK, 2, **size)

    if not is_read:
        with pytest.raises(ValueError, match="takes the shortest axis of an image for its chan"):
            make()
        return
    space = make().observation_space
    if len(space.shape) == 3:
        assert is_image_space_channels_first(space) == size.get("channels_first", False)
