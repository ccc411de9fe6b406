"""One environment: observations, episodes, time limits, bad input."""

from __future__ import annotations

import dataclasses
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pixelbrax_jax
from pixelbrax_jax import EnvConfig, PixelEnv, check_env
from pixelbrax_jax._platform.frame_stack import unpack
from pixelbrax_jax.envs.check import ContractError
from pixelbrax_jax.renderer.base import pack
from pixelbrax_jax.types import Frame
from tests.envs.toy import PARAMS, Ball, limited

RIGHT = jnp.ones(1)


def make(**options) -> PixelEnv:
    return PixelEnv(Ball(), **({"height": 16, "width": 16, "frame_stack": 3} | options))


def test_pack_rounds_to_the_nearest_level():
    level = np.linspace(0, 1, 1021, dtype=np.float32).reshape(1, -1)
    frame = Frame(r=level, g=1 - level, b=level**2, depth=None, seg=None, ground=None)
    pixels = unpack(pack(frame))
    for c, plane in enumerate((level, 1 - level, level**2)):
        np.testing.assert_array_equal(pixels[..., c], np.floor(255 * plane + np.float32(0.5)))


def test_stack_is_oldest_first_and_begins_with_copies():
    env = make()
    state, timestep = env.reset(jax.random.key(0), PARAMS)
    first = np.asarray(timestep.obs)
    assert first.shape == (16, 16, 9)
    assert first.dtype == np.uint8
    seen = [first[..., :3]] * 3
    np.testing.assert_array_equal(first, np.concatenate(seen, axis=-1))
    for _ in range(4):
        state, timestep = env.step(state, RIGHT, PARAMS)
        seen.append(np.asarray(env_frame(env, state)))
        np.testing.assert_array_equal(timestep.obs, np.concatenate(seen[-3:], axis=-1))
    assert (seen[-1] != seen[0]).any()
    state, timestep = env.next_episode(state, PARAMS)
    fresh = np.asarray(timestep.obs)
    np.testing.assert_array_equal(fresh[..., :3], fresh[..., 6:])


def env_frame(env, state):
    """The present frame, rounded here and not by the environment."""
    frame = env.render(state, PARAMS)
    rgb = np.stack([frame.r, frame.g, frame.b], axis=-1)
    return np.floor(255 * rgb + np.float32(0.5)).astype(np.uint8)


def test_obs_modes_show_the_same_episode():
    steps = {}
    for mode in ("pixels", "state", "both"):
        env = make(obs_mode=mode)
        state, _ = env.reset(jax.random.key(3), PARAMS)
        steps[mode] = env.step(state, RIGHT, PARAMS)[1].obs
    np.testing.assert_array_equal(steps["both"]["pixels"], steps["pixels"])
    np.testing.assert_array_equal(steps["both"]["state"], steps["state"])


@pytest.mark.parametrize(
    ("height", "width"), [(1, 1), pytest.param(7, 13, marks=pytest.mark.slow), (40, 24)]
)
def test_any_size(height, width):
    env = make(height=height, width=width, frame_stack=1)
    state, timestep = env.reset(jax.random.key(0), PARAMS)
    assert timestep.obs.shape == (height, width, 3)
    difference = timestep.obs.astype(int) - env_frame(env, state).astype(int)
    assert np.abs(difference).max() <= 1


def test_time_limit_truncates_and_does_not_terminate():
    env, params = make(obs_mode="state"), limited(4)
    state, _ = env.reset(jax.random.key(0), params)
    for k in range(1, 5):
        state, timestep = env.step(state, 0 * RIGHT, params)
        assert not timestep.terminated
        assert bool(timestep.truncated) == (k == 4)
        assert timestep.info["episode_length"] == k


def test_termination_at_the_time_limit_is_no_truncation():
    env = make(obs_mode="state")
    state, _ = env.reset(jax.random.key(0), PARAMS)
    steps = 0
    while not state.done:
        state, timestep = env.step(state, RIGHT, PARAMS)
        steps += 1
    assert timestep.terminated
    state, _ = env.reset(jax.random.key(0), limited(steps))
    for _ in range(steps):
        state, timestep = env.step(state, RIGHT, limited(steps))
    assert timestep.terminated
    assert not timestep.truncated


@pytest.mark.parametrize("action_repeat", [1, pytest.param(2, marks=pytest.mark.slow), 3])
def test_action_repeat_sums_rewards_until_the_end(action_repeat):
    env = make(obs_mode="state", action_repeat=action_repeat)
    assert env.dt == pytest.approx(0.1 * action_repeat)
    state, _ = env.reset(jax.random.key(1), PARAMS)
    x, count, total = float(state.sim.physics.obs[0]), 0, 0.0
    while not state.done:
        state, timestep = env.step(state, RIGHT, PARAMS)
        reward = 0.0
        for _ in range(action_repeat):
            x, count = x + 0.1, count + 1
            reward += x
            if x > 1:
                break
        total += reward
        assert float(timestep.reward) == pytest.approx(reward, rel=1e-5)
        assert int(timestep.info["episode_length"]) == count
        assert float(timestep.info["episode_return"]) == pytest.approx(total, rel=1e-5)
    assert timestep.terminated


def test_action_repeat_stops_at_the_time_limit():
    env, params = make(obs_mode="state", action_repeat=3), limited(4)
    state, _ = env.reset(jax.random.key(1), params)
    state, timestep = env.step(state, 0 * RIGHT, params)
    assert not timestep.truncated
    state, timestep = env.step(state, 0 * RIGHT, params)
    assert timestep.truncated
    assert timestep.info["episode_length"] == 4
    assert state.sim.physics.obs[1] == 4


def test_actions_are_clipped_once():
    env = make(obs_mode="state")
    state, _ = env.reset(jax.random.key(0), PARAMS)
    _, far = env.step(state, 7 * RIGHT, PARAMS)
    _, one = env.step(state, RIGHT, PARAMS)
    np.testing.assert_array_equal(far.obs, one.obs)


def test_nan_action_ends_the_episode_and_a_reset_is_clean():
    env = make()
    state, _ = env.reset(jax.random.key(0), PARAMS)
    broken, timestep = env.step(state, jnp.full(1, jnp.nan), PARAMS)
    assert timestep.terminated
    assert timestep.info["non_finite"]
    assert timestep.reward == 0
    np.testing.assert_array_equal(timestep.obs[..., 6:], state.frames[..., 6:])
    _, fresh = env.next_episode(broken, PARAMS)
    assert not fresh.terminated
    assert not fresh.info["non_finite"]


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("height", 0, "height must be a positive integer, got 0"),
        ("width", -3, "width must be"),
        ("width", 2.5, "width must be a positive integer"),
        ("frame_stack", 0, "frame_stack must be"),
        ("action_repeat", 0, "action_repeat must be"),
        ("action_repeat", True, "action_repeat must be"),
        ("obs_mode", "pixel", "unknown obs_mode: 'pixel'.*Did you mean 'pixels'"),
        ("renderer", "fuse", "Did you mean 'fused'"),
    ],
)
def test_bad_options(option, value, message):
    with pytest.raises(ValueError, match=message):
        make(**{option: value})


def test_bad_actions_and_keys():
    env = make(obs_mode="state")
    state, _ = env.reset(jax.random.key(0), PARAMS)
    with pytest.raises(ValueError, match=r"action must have shape \(1,\), got \(2,\)"):
        env.step(state, jnp.ones(2), PARAMS)
    with pytest.raises(TypeError, match="action must be floating point"):
        env.step(state, jnp.ones(1, int), PARAMS)
    with pytest.raises(TypeError, match=r"jax.random.key\(seed\), got uint32\[2\]"):
        env.reset(jax.random.PRNGKey(0), PARAMS)
    with pytest.raises(TypeError, match=r"key must have shape \(\), got \(2,\)"):
        env.reset(jax.random.split(jax.random.key(0)), PARAMS)


class TestMake:
    def test_equal_options_make_equal_environments(self):
        first, _ = pixelbrax_jax.make("inverted_pendulum", height=16, width=16)
        second, params = pixelbrax_jax.make(
            "inverted_pendulum", width=16, height=16, look="original", episode_length=5
        )
        assert first == second
        assert hash(first) == hash(second)
        assert params.episode_length == 5
        for options in ({"height": 17}, {"backend": "spring"}, {"obs_mode": "both"}):
            other, _ = pixelbrax_jax.make(
                "inverted_pendulum", **{"height": 16, "width": 16} | options
            )
            assert other != first

    def test_physics_of_ones_own_are_compared_by_the_object(self):
        class Own(Ball):
            """Physics as most users write them: equal to itself alone."""

            __eq__ = object.__eq__
            __hash__ = object.__hash__

        ball = Own()
        assert PixelEnv(ball) == PixelEnv(ball)
        assert PixelEnv(ball) != PixelEnv(Own())

    @pytest.mark.parametrize("value", [jnp.int32(16), np.zeros(2), [16]])
    def test_arrays_are_no_options(self, value):
        with pytest.raises(TypeError, match=r"height .*must be a single value"):
            pixelbrax_jax.make("ant", height=value)

    def test_a_traced_option_is_named(self):
        with pytest.raises(TypeError, match="frame_stack decides which program is compiled"):
            jax.jit(lambda n: pixelbrax_jax.make("ant", frame_stack=n)[1].look.light)(3)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"task": "antt"}, r"unknown task: 'antt'\. Did you mean 'ant'\? Allowed: ant, "),
            ({"task": "PixelBrax/Ant-v0"}, "unknown task: .* Did you mean 'ant'"),
            ({"backend": "sprng"}, "Did you mean 'spring'"),
            ({"camera": "sid"}, "unknown camera of task 'ant': 'sid'.*Did you mean 'side'"),
            (
                {"look": "orginal"},
                r"'orginal'\. .*'original'\? Allowed: default, dmc, dmc-plain, original",
            ),
            ({"reward_preset": "papers"}, "Did you mean 'paper'"),
            ({"obs_mode": "image"}, "unknown obs_mode: 'image'; allowed: both, depth, pixels"),
        ],
    )
    def test_unknown_names_list_what_is_allowed(self, options, message):
        with pytest.raises(ValueError, match=message):
            pixelbrax_jax.make(**({"task": "ant"} | options))

    def test_a_misspelt_option_is_named(self):
        message = (
            r"unexpected keyword argument 'heigth'; allowed: .*, width\. Did you mean 'height'\?"
        )
        with pytest.raises(TypeError, match=message):
            pixelbrax_jax.make("ant", heigth=84)
        with pytest.raises(
            TypeError, match=r"unexpected keyword argument 'zzz'; allowed: .*, width\.$"
        ):
            pixelbrax_jax.make("ant", zzz=84)

    def test_the_signature_is_there_for_editors(self):
        parameters = inspect.signature(pixelbrax_jax.make).parameters
        assert next(iter(parameters)) == "task"
        assert parameters["height"].default == 84
        assert parameters["height"].annotation == "int"
        assert set(parameters) == {field.name for field in dataclasses.fields(EnvConfig)}

    def test_a_rig_must_follow_a_link_that_exists(self):
        rig = pixelbrax_jax.make_rig((0, -3, 1), (0, 0, 0), 40.0, link=99)
        with pytest.raises(ValueError, match="follows link 99, but task 'ant' has only 9 links"):
            pixelbrax_jax.make("ant", camera=rig)


class TestCheckEnv:
    @pytest.mark.parametrize(
        "mode", ["pixels", *(pytest.param(m, marks=pytest.mark.slow) for m in ("state", "both"))]
    )
    def test_accepts_a_good_task(self, mode):
        check_env(make(obs_mode=mode, frame_stack=2), PARAMS)

    def test_catches_broken_tasks(self):
        class Forgetful(Ball):
            def reset(self, key):
                return super().reset(jax.random.key(0))

        class RewardedReset(Ball):
            def step(self, state, action):
                return super().step(state, action).replace(reward=jnp.int32(1))

        class Leaky(Ball):
            def step(self, state, action):
                moved = super().step(state, action)
                return moved.replace(obs=moved.obs + 0 * action, terminated=moved.obs[0] > 1)

        class WrongSize(Ball):
            state_size = 3

        for task, rule in (
            (Forgetful, "different keys must start differently"),
            (RewardedReset, "timestep after a step must keep its structure|reward of step"),
            (Leaky, "a NaN action must terminate"),
            (WrongSize, "the observation of reset must be"),
        ):
            with pytest.raises(ContractError, match=rule):
                check_env(PixelEnv(task(), obs_mode="state"), PARAMS)
