"""Distractors together: with each other, with episodes and batches, with make()."""

from __future__ import annotations

import gc
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import pixelbrax_jax as pb
from pixelbrax_jax import distractors
from pixelbrax_jax.distractors import Color, MovingCamera, Video
from pixelbrax_jax.distractors.base import Chain, Distractor
from pixelbrax_jax.distractors.presets import resolve
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.generalisation.suites import levels_of
from tests.distractors.conftest import SIZE, make_bank, make_clips
from tests.envs.toy import PARAMS, Ball

ALL = (Color(), MovingCamera(scale=0.3), Video())
WITH_CLIPS = PARAMS.replace(clips=make_clips())
ACTIONS = np.random.default_rng(0).uniform(-1, 1, (30, 8, 1)).astype(np.float32)


def rollout(chain, mode="next_step", num_envs=8, episode_length=7, **options):
    """Timesteps of thirty steps with episodes of seven."""
    options = SIZE | {"obs_mode": "both"} | options
    params = WITH_CLIPS.replace(episode_length=np.int32(episode_length))
    env = pb.VectorPixelEnv(PixelEnv(Ball(), distractors=chain, **options), num_envs, mode)
    state, timestep = env.reset(jax.random.key(0), params)
    seen = [timestep]
    for action in ACTIONS[:, :num_envs]:
        state, timestep = env.step(state, action, params)
        info = {k: v for k, v in timestep.info.items() if not k.startswith("final")}
        seen.append(timestep.replace(info=info))
    return jax.tree.map(lambda *x: np.stack(x), *seen)


@pytest.fixture(scope="module")
def runs():
    return rollout(ALL), rollout(())


def test_state_reward_and_flags_are_the_same_bits(runs):
    changed, clean = runs
    np.testing.assert_array_equal(changed.obs["state"], clean.obs["state"])
    for name in ("reward", "terminated", "truncated"):
        np.testing.assert_array_equal(getattr(changed, name), getattr(clean, name))
    for name in ("episode_return", "episode_length", "non_finite"):
        np.testing.assert_array_equal(changed.info[name], clean.info[name])
    assert (changed.obs["pixels"] != clean.obs["pixels"]).mean() > 0.8


@pytest.mark.parametrize("name", ["episode_return", "color"])
def test_an_entry_of_info_has_one_owner(name):
    class Meddler(Distractor):
        kind, stream = "meddler", 99

        def info(self, state):
            return {name: state}

    chain = Chain((Color(), Meddler()))
    with pytest.raises(ValueError, match=f"info of distractor 'meddler' has '{name}', which is ta"):
        chain.info((jnp.zeros(3), jnp.zeros(())))


def test_info_tells_of_every_distractor(runs):
    info = runs[0].info
    shape = info["episode_length"].shape
    assert info["color"].shape == (*shape, 3)
    assert info["camera"].shape == (*shape, 4)
    assert info["video_clip"].shape == info["video_frame"].shape == shape
    assert set(runs[1].info) == {"episode_return", "episode_length", "non_finite"}


def test_every_episode_and_environment_is_another(runs):
    info = runs[0].info
    first = info["episode_length"] == 0
    # The camera's place at the first frame of each episode of each environment.
    places = info["camera"][first][:, 1]
    assert len(places) > 24
    assert len(np.unique(places)) == len(places)
    assert len(np.unique(info["color"][0])) == info["color"][0].size


@pytest.mark.slow
def test_neighbors_do_not_matter(runs):
    few = rollout(ALL, num_envs=3)
    for name in ("video_clip", "video_frame"):
        np.testing.assert_array_equal(few.info[name], runs[0].info[name][:, :3])
    for name in ("color", "camera"):
        np.testing.assert_allclose(few.info[name], runs[0].info[name][:, :3], atol=1e-5)


@pytest.mark.slow
def test_other_modes_begin_the_same_episodes(runs):
    other = rollout(ALL, "same_step")

    def clips(info):
        return info["video_clip"][:, 0][info["episode_length"][:, 0] == 0].tolist()

    shared = min(len(clips(runs[0].info)), len(clips(other.info)))
    assert shared >= 3
    assert clips(runs[0].info)[:shared] == clips(other.info)[:shared]


def test_frames_advance_once_for_each_step_under_action_repeat():
    loop = Video(dynamics="loop", num_clips=1, random_start=False)
    seen = rollout((loop,), action_repeat=2, episode_length=100)
    frames = seen.info["video_frame"][:, 0].tolist()
    ended = np.flatnonzero(seen.terminated[:, 0])
    until = ended[0] if len(ended) else len(frames)
    assert frames[:until] == [t % 5 for t in range(until)]


def test_an_early_time_limit_does_not_move_the_video():
    loop = Video(dynamics="loop", num_clips=1, random_start=False)
    env = PixelEnv(Ball(), **SIZE, distractors=(loop,))
    params = WITH_CLIPS.replace(episode_length=np.int32(6))
    state, _ = env.reset(jax.random.key(0), params)
    state = state.replace(sim=state.sim.replace(time_limit_offset=jnp.int32(3)))
    for step in (1, 2, 3):
        state, timestep = env.step(state, jnp.zeros(1), params)
        assert int(timestep.info["video_frame"]) == step
        assert int(timestep.info["episode_length"]) == step
    assert timestep.truncated
    state, timestep = env.next_episode(state, WITH_CLIPS)
    assert int(state.sim.time_limit_offset) == 0


def test_order_of_giving_does_not_matter():
    assert Chain(ALL[::-1]).links == Chain(ALL).links


@pytest.mark.slow
def test_images_do_not_depend_on_the_order_of_giving(runs):
    reordered = rollout(ALL[::-1])
    np.testing.assert_array_equal(reordered.obs["pixels"], runs[0].obs["pixels"])


def test_what_cannot_work_together_is_refused():
    class Nameless(distractors.Distractor):
        pass

    class Twin(distractors.Distractor):
        kind, stream = "twin", 1

    class Reset(distractors.Distractor):
        kind, stream = "reset", 0

    class Unhashable(distractors.Distractor):
        kind, stream = "unhashable", 50
        __hash__ = None

    for given, error, message in (
        ((Color(), Color(scale=0.1)), ValueError, "two distractors of kind 'color'"),
        (("color",), TypeError, "expected a Distractor, got str; only pixelbrax_jax.make"),
        ((Nameless(),), TypeError, "Nameless needs a kind"),
        ((Reset(),), ValueError, "Reset needs a stream, a positive integer, got 0"),
        ((Twin(), Color()), ValueError, "twin, color must have different streams"),
        ((Unhashable(),), TypeError, "Unhashable cannot be hashed; make it a frozen"),
    ):
        with pytest.raises(error, match=message):
            Chain(given)


def test_state_observations_carry_no_distractors():
    env = PixelEnv(Ball(), obs_mode="state", distractors=ALL)
    state, timestep = env.reset(jax.random.key(0), PARAMS)
    assert state.sim.distractor_state == ()
    assert "color" not in timestep.info


def test_a_distractor_of_your_own():
    class Darkness(distractors.Distractor):
        kind, stream = "darkness", 9

        def reset(self, key, params):
            return jax.random.uniform(key)

        def change_frame(self, state, frame, backdrop):
            return frame.replace(r=state * frame.r, g=state * frame.g, b=state * frame.b)

    env = PixelEnv(Ball(), **SIZE, distractors=(Darkness(), Color(scale=0.0)))
    clean = PixelEnv(Ball(), **SIZE)
    state, _ = env.reset(jax.random.key(0), PARAMS)
    bare, _ = clean.reset(jax.random.key(0), PARAMS)
    darkness = state.sim.distractor_state[-1]
    np.testing.assert_allclose(
        env.render(state, PARAMS).r, darkness * clean.render(bare, PARAMS).r, atol=1e-6
    )


def test_a_change_that_returns_nothing_is_told():
    class Forgetful(distractors.Distractor):
        kind, stream = "forgetful", 9

        def reset(self, key, params):
            return ()

        def change_frame(self, state, frame, backdrop):
            frame.replace(r=frame.g)

    env = PixelEnv(Ball(), **SIZE, distractors=(Forgetful(),))
    with pytest.raises(TypeError, match="'forgetful' must return a Frame, got a NoneType"):
        env.reset(jax.random.key(0), PARAMS)


def test_presets():
    assert distractors.preset("paper-video", "ant") == (
        Video(mode="overlay", alpha=0.5, dynamics="loop"),
    )
    for level, scale, clips in (("easy", 0.1, 4), ("medium", 0.2, 8), ("hard", 0.3, None)):
        camera, video, color = distractors.preset(f"dcs-{level}", "ant")
        assert (camera.scale, camera.dynamic) == (scale, True)
        assert (video.num_clips, video.dynamics, video.ground_alpha) == (clips, "pingpong", 0.3)
        assert (color.mode, color.dynamics, color.scale) == ("geom", "walk", scale)
        camera, video, color = distractors.preset(f"dcs-{level}-static", "reacher")
        assert not camera.dynamic
        assert (video.dynamics, video.ground_alpha, color.dynamics) == ("static", 0.0, "static")
    easy, hard = (distractors.preset(f"video-{n}", "ant")[0] for n in ("easy", "hard"))
    assert (easy.ground_alpha, hard.ground_alpha) == (1.0, 0.0)
    for level, scale in (("easy", 0.1), ("hard", 0.2)):
        (color,) = distractors.preset(f"color-{level}", "dmc_walker_walk")
        assert (color.mode, color.dynamics, color.distribution) == ("geom", "static", "normal")
        assert (color.scale, color.sky, color.materials) == (scale, True, ("self", "grid"))
    for name in distractors.PRESETS:
        assert distractors.preset(name, "ant")


def test_ground_under_videos_of_dm_controls_tasks():
    """By domain, as the Distracting Control Suite has it; the Brax tasks of like names differ."""
    kept = {
        "dmc_reacher_easy": 0.0,
        "dmc_walker_run": 1.0,
        "dmc_cheetah_run": 1.0,
        "dmc_hopper_hop": 0.3,
        "dmc_ball_in_cup_catch": 0.3,
        "hopper": 1.0,
        "walker_of_mine": 0.3,
    }
    for task, alpha in kept.items():
        _, video, _ = distractors.preset("dcs-easy", task)
        assert video.ground_alpha == alpha, task


def test_color_on_the_ground_of_dm_controls_tasks():
    """The Distracting Control Suite changes the white material of its texture."""
    for task, ground in (("dmc_walker_run", "texture"), ("walker2d", True)):
        for name in ("dcs-hard", "dcs-easy-static"):
            assert distractors.preset(name, task)[-1].ground == ground
    for task, ground in (("dmc_walker_run", "texture"), ("ant", True)):
        color = levels_of("dmcgb", task)[-1].changes[-1]
        assert (color.kind, color.ground) == ("color", ground)


def test_names_and_objects_may_be_mixed():
    assert resolve("color", "ant") == (Color(),)
    assert resolve(("video", Color(scale=0.1)), "ant") == (
        Video(),
        Color(scale=0.1),
    )
    with pytest.raises(ValueError, match=r"unknown distractor: 'dcs-eazy'.*mean 'dcs-easy'"):
        resolve("dcs-eazy", "ant")
    with pytest.raises(TypeError, match="a name or a Distractor, got int"):
        resolve((3,), "ant")


def test_clips_of_a_folder_are_on_the_device_once(tmp_path, monkeypatch):
    monkeypatch.setenv("PIXELBRAX_CACHE", str(tmp_path / "cache"))
    (tmp_path / "clips" / "one").mkdir(parents=True)
    Image.new("RGB", (8, 8), "red").save(tmp_path / "clips" / "one" / "0.png")
    options = {"height": 8, "width": 8, "distractors": "video"}

    def make():
        source = {"clips": tmp_path / "clips", "split": "all"}
        return pb.make("inverted_pendulum", **source, **options)[1].clips

    one, other = make(), make()
    assert one.packed is other.packed
    clips = weakref.ref(one)
    del one, other
    gc.collect()
    assert clips() is None, "clips leave with the last who shows them"


def test_make_shares_clips_and_warns_of_procedural_ones():
    options = {"height": 16, "width": 16}
    with pytest.warns(
        distractors.ProceduralClipsWarning, match="not comparable with DAVIS"
    ) as told:
        pb.make("inverted_pendulum", distractors="video", **options)
    assert told[0].filename == __file__
    _, params = pb.make(
        "inverted_pendulum", distractors="video", clips="procedural", split="test", **options
    )
    _, again = pb.make(
        "inverted_pendulum", distractors=("video",), clips="procedural", split="test", **options
    )
    assert params.clips.packed is again.clips.packed
    assert params.clips.packed.shape == (8 * 64, 16, 16)
    _, plain = pb.make("inverted_pendulum", distractors="color", **options)
    assert plain.clips is None
    bank = make_bank()
    _, own = pb.make("inverted_pendulum", distractors="video", clips=bank, **options)
    assert own.clips.packed.shape == (14, 24, 20)
    assert pb.make("inverted_pendulum", distractors=None, **options)[1].clips is None
    with pytest.raises(ValueError, match="clips are given without a video"):
        pb.make("inverted_pendulum", distractors="color", clips="procedural", **options)
    with pytest.raises(ValueError, match="split='test', but the clips are of split 'train'"):
        pb.make("inverted_pendulum", distractors="video", clips=bank, split="test", **options)
    with pytest.raises(ValueError, match="unknown split of procedural clips: 'val'"):
        pb.make("inverted_pendulum", distractors="video", clips="procedural", split="val")


@pytest.mark.parametrize(
    ("distractor", "options", "message"),
    [
        (Color, {"mode": "pixel"}, "unknown mode of Color: 'pixel'.*frame, geom"),
        (Color, {"dynamics": "random"}, "unknown dynamics of Color"),
        (Color, {"distribution": "gauss"}, "unknown distribution of Color"),
        (Color, {"scale": 2.0}, r"scale of Color must lie in \[0, 1\], got 2.0"),
        (Color, {"scale": float("nan")}, r"scale of Color must lie in \[0, 1\], got nan"),
        (Color, {"mode": "geom", "materials": "self"}, r"must be a tuple of names, .* got 'self'"),
        (
            Color,
            {"mode": "geom", "materials": ["self"]},
            r"must be a tuple of names, .* got \['self'\]",
        ),
        (Color, {"mode": "geom", "materials": ("",)}, r"must be a tuple of names, .* got \(''"),
        (Color, {"scale": "0.3"}, r"scale of Color must lie in \[0, 1\], got '0.3'"),
        (Video, {"mode": "foreground"}, "unknown mode of Video: 'foreground'.*overlay"),
        (Video, {"dynamics": "ping-pong"}, "Did you mean 'pingpong'"),
        (Video, {"alpha": 1.5}, r"alpha of Video must lie in \[0, 1\], got 1.5"),
        (Video, {"ground_alpha": -0.1}, r"ground_alpha of Video must lie in \[0, 1\], got -0.1"),
        (Video, {"mode": "overlay", "ground_alpha": 0.0}, "only for mode='background'"),
        (Video, {"num_clips": 0}, "num_clips of Video must be a positive integer, got 0"),
        (MovingCamera, {"scale": -1}, r"scale of MovingCamera must lie in \[0, 1\], got -1"),
        (Color, {"sky": True}, r"sky, materials and ground of Color are only for mode='geom'"),
        (
            Color,
            {"mode": "geom", "materials": ("self",), "ground": False},
            "materials of Color name all that shifts: leave out ground",
        ),
        (Color, {"ground": False}, r"sky, materials and ground of Color are only for mode='geom'"),
    ],
)
def test_options_are_checked(distractor, options, message):
    with pytest.raises(ValueError, match=message):
        distractor(**options)


@pytest.mark.parametrize(
    ("distractor", "options", "message"),
    [
        (Color, {"mode": "geom", "sky": "no"}, "sky of Color must be True or False, got 'no'"),
        (
            Color,
            {"mode": "geom", "ground": 1},
            "ground of Color must be True, False or 'texture', got 1",
        ),
        (MovingCamera, {"dynamic": "false"}, "dynamic of MovingCamera must be True or False"),
        (Video, {"random_start": "no"}, "random_start of Video must be True or False"),
    ],
)
def test_words_are_no_bools(distractor, options, message):
    with pytest.raises(TypeError, match=message):
        distractor(**options)
