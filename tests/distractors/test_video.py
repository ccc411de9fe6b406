"""The video distractor: which frame is shown, and where in the image."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import VectorPixelEnv, distractors
from pixelbrax_jax.distractors.video import frame_index
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.types import GeomKind
from tests.distractors.conftest import SIZE, episode, make_clips, walk
from tests.envs.toy import PARAMS, Ball


def counted(dynamics, length, start, direction, frames):
    """The indices by a counter that is carried along."""
    index, seen = start, []
    for _ in range(frames):
        seen.append(index)
        if dynamics == "loop":
            index = (index + direction) % length
        elif dynamics == "pingpong" and length > 1:
            if not 0 <= index + direction < length:
                direction = -direction
            index += direction
    return seen


@pytest.mark.parametrize("dynamics", ["loop", "pingpong", "static"])
@pytest.mark.parametrize("length", [1, 2, 3, 7])
@pytest.mark.parametrize("direction", [1, -1])
def test_closed_form_is_the_counter(dynamics, length, direction):
    frames = 3 * max(2 * (length - 1), length) + 2
    for start in range(length):
        closed = [int(frame_index(dynamics, length, start, direction, t)) for t in range(frames)]
        assert closed == counted(dynamics, length, start, direction, frames)


def test_an_overlay_covers_everything():
    video = episode(distractors.Video(mode="overlay", alpha=0.25, dynamics="loop"), 5)
    clean = episode(None, 5)
    clips = make_clips()
    for (timestep, frame, _), (_, plain, _) in zip(video, clean, strict=True):
        info = timestep.info
        word = clips.packed[clips.first[info["video_clip"]] + info["video_frame"]]
        for shift, plane, bare in ((0, frame.r, plain.r), (8, frame.g, plain.g)):
            expected = 0.75 * bare + 0.25 * ((word >> shift) & 0xFF) / 255.0
            np.testing.assert_allclose(plane, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("ground_alpha", "alpha"),
    [pytest.param(1.0, 1.0, marks=pytest.mark.slow), (0.3, 0.4), (0.0, 0.0)],
)
def test_a_background_leaves_the_agent_alone(ground_alpha, alpha):
    video = episode(distractors.Video(ground_alpha=ground_alpha, alpha=alpha), 5)
    clean = episode(None, 5)
    clips = make_clips()
    ground = Ball.geoms.kind.index(GeomKind.PLANE)
    for (timestep, frame, _), (bare, plain, _) in zip(video, clean, strict=True):
        info = timestep.info
        word = clips.packed[clips.first[info["video_clip"]] + info["video_frame"]]
        red = (word & 0xFF) / 255.0
        sky, floor = plain.seg == -1, plain.seg == ground
        agent = ~sky & ~floor
        assert agent.any()
        assert sky.any()
        assert floor.any()
        newest, clean_pixels = timestep.obs[..., -3:], bare.obs[..., -3:]
        np.testing.assert_array_equal(newest[agent], clean_pixels[agent])
        # Programs differ in rounding.
        np.testing.assert_allclose(frame.r[agent], plain.r[agent], atol=5e-6)
        expected = (1 - alpha) * plain.r + alpha * red
        np.testing.assert_allclose(frame.r[sky], expected[sky], atol=5e-6)
        if alpha == 0.0:
            np.testing.assert_array_equal(frame.r[sky], plain.r[sky])
        expected = ground_alpha * plain.r + (1 - ground_alpha) * red
        np.testing.assert_allclose(frame.r[floor], expected[floor], atol=5e-6)


def test_every_frame_shows_the_clip_in_order():
    params = PARAMS.replace(clips=make_clips())
    for dynamics in ("loop", "pingpong", "static"):
        states = walk(distractors.Video(dynamics=dynamics), params, 12, num=4)
        for i in range(4):
            clip, start, direction = (
                int(x[0, i]) for x in (states.clip, states.start, states.direction)
            )
            expected = counted(dynamics, int(params.clips.length[clip]), start, direction, 12)
            assert states.frame[:, i].tolist() == expected[1:]


def test_an_episode_draws_a_clip_a_start_and_a_direction():
    env = VectorPixelEnv(
        PixelEnv(Ball(), **SIZE, distractors=(distractors.Video(),)), 64, "next_step"
    )
    params = PARAMS.replace(clips=make_clips())
    state, _ = env.reset(jax.random.key(0), params)
    video = state.sim.distractor_state[0]
    assert set(np.asarray(video.clip).tolist()) == {0, 1, 2}
    assert set(np.asarray(video.direction).tolist()) == {-1, 1}
    longest = int(np.argmax(params.clips.length))
    assert len(set(np.asarray(video.start)[np.asarray(video.clip) == longest].tolist())) > 3
    later, _ = env.reset_where(state, jnp.ones(64, bool), params)
    assert (np.asarray(later.sim.distractor_state[0].clip) != np.asarray(video.clip)).any()
    # A clip of one frame stays there.
    assert not np.asarray(video.start)[np.asarray(video.clip) == 1].any()


def test_pictures_of_another_size_show_the_same_video():
    env = PixelEnv(Ball(), **SIZE, distractors=(distractors.Video(mode="overlay", alpha=1.0),))
    params = PARAMS.replace(clips=make_clips())
    state, timestep = env.reset(jax.random.key(0), params)
    large = env.image(state, params, 2 * SIZE["height"], 3 * SIZE["width"])
    small = timestep.obs[..., -3:]
    np.testing.assert_array_equal(large[::2, ::3], small)
    np.testing.assert_array_equal(large[1::2, 2::3], small)


def test_no_clips():
    env = PixelEnv(Ball(), **SIZE, distractors=(distractors.Video(),))
    with pytest.raises(ValueError, match=r"Video needs clips.*load_clips"):
        env.reset(jax.random.key(0), PARAMS)
