"""Levels of the suites: their sources' numbers, what they share, what training cannot show."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from pixelbrax_jax import VectorPixelEnv, make
from pixelbrax_jax.agents.runner.settings import clip_digests
from pixelbrax_jax.config import EnvConfig
from pixelbrax_jax.distractors.base import Chain
from pixelbrax_jax.distractors.clips import load_clips
from pixelbrax_jax.distractors.color import Color
from pixelbrax_jax.distractors.light import Light
from pixelbrax_jax.distractors.presets import PRESETS, preset
from pixelbrax_jax.distractors.video import Video
from pixelbrax_jax.generalisation.changes import Radius, Rotation, Shift
from pixelbrax_jax.generalisation.making import make_levels
from pixelbrax_jax.generalisation.suites import EPISODES, SUITES, levels_of
from pixelbrax_jax.tasks import SUITES as TASK_SUITES
from tests.agents.test_splits import write_clips
from tests.generalisation.conftest import TASK, TINY

CONFIG = EnvConfig(task=TASK, **TINY)


def levels(suite, episodes=4, clips=None, config=CONFIG, **more):
    made = make_levels(config, suite, episodes, clips, **more)
    return made, {one.level.name: one for one in made.levels}


def test_dmc_gb2_has_twelve_levels():
    rows = {level.name: level for level in levels_of("dmcgb2", "dmc_walker_walk")}
    kinds = ("color", "video", "color-video", "rotate", "shift", "rotate-shift")
    assert set(rows) == {"clean", *(f"{k}-{d}" for k in kinds for d in ("easy", "hard"))}
    assert rows["rotate-easy"].changes == (Rotation(90.0),)
    ten, six = Shift((-10.0, 10.0), (-10.0, 10.0)), 10 / 1.5
    assert rows["shift-hard"].changes == (ten,)
    assert rows["shift-easy"].changes == (Shift((-six, six), (-six, six)),)
    assert rows["rotate-shift-hard"].changes == (ten, Rotation(180.0))
    numbers = {n: r.num_clips for n, r in rows.items() if r.clips}
    assert set(numbers.values()) == {10, 100}
    assert all((n == 100) == name.endswith("hard") for name, n in numbers.items())
    # The ground is gone in one level alone.
    gone = [n for n, r in rows.items() for c in r.changes if getattr(c, "ground_alpha", 1) == 0]
    assert gone == ["video-hard"]
    assert SUITES["dmcgb2"].episodes == 100
    for task in ("dmc_finger_spin", "dmc_cartpole_swingup", "dmc_ball_in_cup_catch"):
        assert len(levels_of("dmcgb2", task)) == 13


def test_dmcontrol_gb_has_eight_intensities():
    rows = levels_of("dmcgb", "dmc_reacher_easy")
    assert SUITES["dmcgb"].episodes == 30
    intensities = [r for r in rows if r.name.startswith("distracting-")]
    scales = [r.changes[0].scale for r in intensities]
    assert scales == [0.025, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5]
    assert [r.num_clips for r in intensities] == [2, 2, 4, 6, 8, None, None, None]
    for row in intensities:
        camera, video, color = row.changes
        assert (camera.dynamic, video.dynamics, color.dynamics) == (True, "pingpong", "walk")
        assert camera.scale == color.scale
        assert video.ground_alpha == 0.0, "the reacher's"


def test_dcs_has_its_presets_on_both_splits():
    rows = {level.name: level for level in levels_of("dcs", "dmc_cheetah_run")}
    assert len(rows) == 13
    hard = rows["hard-static-test"]
    assert (hard.clips, hard.num_clips) == (("test",), None)
    assert hard.changes == preset("dcs-hard-static", "dmc_cheetah_run")
    assert [rows[f"{d}-dynamic-train"].num_clips for d in ("easy", "medium", "hard")] == [
        4,
        8,
        None,
    ]


def test_an_agent_can_train_on_each_axis():
    """Under the distractor of the middle level, or one that draws up to its change."""
    rows = {level.name: level for level in levels_of("axes", "dmc_walker_walk")}
    axes = [name.removesuffix("-2") for name in rows if name.endswith("-2")]
    assert [f"axis-{axis}" for axis in axes] == [n for n in PRESETS if n.startswith("axis-")]
    for axis in axes:
        (trained,), (tested,) = preset(f"axis-{axis}", "dmc_walker_walk"), rows[f"{axis}-2"].changes
        if isinstance(trained, Light):
            sizes = {"direction": 0.0, "intensity": 0.0, "color": 0.0}
            sizes[axis.removeprefix("light-")] = next(iter(vars(tested).values()))
            assert vars(trained) == sizes
        elif axis == "body-color":
            assert trained == Color("geom", "static", tested.scale, ground=False)
        else:
            assert trained == tested
    assert rows["background-2"].clips == ("test",)


def test_subtle_has_five_sizes():
    sizes = {
        "dmc_ball_in_cup_catch": 1 / 12,
        "dmc_cartpole_swingup": 1 / 20,
        "dmc_finger_turn_hard": 1 / 2,
        "dmc_point_mass_easy": 1 / 6,
        "dmc_reacher_hard": 1 / 3,
    }
    for task, factor in sizes.items():
        _, subtle = levels_of("subtle", task)
        assert isinstance(subtle.changes[0], Radius)
        assert subtle.changes[0].factor == factor
        assert task in TASK_SUITES["dmc"].tasks


@pytest.mark.parametrize(
    ("suite", "num_levels", "num_programs"),
    [("axes", 34, 16), ("dmcgb", 13, 11), ("dcs", 13, 5), ("paper", 3, 3), ("tiny", 3, 1)],
)
def test_levels_share_programs(suite, num_levels, num_programs):
    clips = None if suite == "tiny" else "procedural"
    made, by_name = levels(suite, clips=clips)
    assert (len(made.levels), made.num_programs) == (num_levels, num_programs)
    # Clean is the task itself in every episode.
    _, params = make(CONFIG)
    clean = by_name["clean"].params
    for own, expected in zip(jax.tree.leaves(clean), jax.tree.leaves(params), strict=True):
        assert np.array_equal(np.broadcast_to(expected, np.shape(own)), own)


def test_what_a_level_does_not_change_has_no_rows():
    _, by_name = levels("tiny")
    params = by_name["turned"].params
    assert params.rig.up.shape == (4, 3)
    assert params.geoms.rgb.shape == (4, 2, 3)
    assert params.look.sky.shape == (2, 3)
    assert np.array_equal(by_name["painted"].params.rig.up[0], by_name["clean"].params.rig.up[0])


def test_palettes_are_those_of_the_distractor_and_of_no_training():
    _, by_name = levels("dmcgb", clips="procedural")
    (color,) = preset("color-hard", TASK)
    assert isinstance(color, Color)
    _, base = make(CONFIG)
    keys = VectorPixelEnv.env_keys(jax.random.key(EPISODES), 4)
    drawn = by_name["color-hard"].params
    for i, key in enumerate(keys):
        last, first = (jax.random.fold_in(key, episode) for episode in (2**32 - 1, 0))
        (shift,) = Chain((color,)).reset(last, base)
        expected = color.change_params(shift, base)
        np.testing.assert_allclose(drawn.geoms.rgb[i], expected.geoms.rgb, atol=1e-6)
        np.testing.assert_allclose(drawn.look.sky[i], expected.look.sky, atol=1e-6)
        (of_training,) = Chain((color,)).reset(first, base)
        assert not np.allclose(of_training, shift, atol=1e-3)


def test_clips_come_in_order_from_the_held_out_split():
    made, by_name = levels("dmcgb", episodes=10, clips="procedural")
    size = {"height": 18, "width": 18}
    train = set(clip_digests(load_clips("procedural", "train", **size).to_device()))
    digests = clip_digests(made.bank.to_device())
    assert {digests[clip] in train for clip in made.splits["test"]} == {False}
    assert {digests[clip] in train for clip in made.splits["train"]} == {True}
    firsts = made.bank.first[list(made.splits["test"])]
    assert by_name["video-hard"].params.clips.first[:, 0].tolist() == [
        firsts[i % 8] for i in range(10)
    ]
    # Intensity 0.025 has two clips, of training.
    shown = set(by_name["distracting-0.025"].params.clips.first[:, 0].tolist())
    assert shown == set(made.bank.first[list(made.splits["train"])[:2]].tolist())


def test_one_folder_has_the_clips_of_both_benchmarks(tmp_path, monkeypatch):
    monkeypatch.setenv("PIXELBRAX_CACHE", str(tmp_path / "cache"))
    data = tmp_path / "data"
    write_clips(data / "video_easy", "abc")
    write_clips(data / "video_hard", "de")
    write_clips(data / "DAVIS" / "JPEGImages" / "480p", "fg")
    lists = data / "DAVIS" / "ImageSets" / "2017"
    lists.mkdir(parents=True)
    (lists / "train.txt").write_text("g\nf\n")
    made, by_name = levels("dmcgb", clips=data)
    shown = {name: [made.bank.names[i] for i in clips] for name, clips in made.splits.items()}
    assert shown == {"video_easy": ["a", "b", "c"], "video_hard": ["d", "e"], "train": ["g", "f"]}
    assert by_name["video-easy"].params.clips.first[:, 0].tolist() == [0, 2, 4, 0]
    assert by_name["video-hard"].params.clips.first[:, 0].tolist() == [6, 8, 6, 8]


def test_an_episode_shows_its_clip_from_the_first_frame():
    made, by_name = levels("axes", episodes=2, clips="procedural")
    one = by_name["background-2"]
    assert isinstance(one.env.distractors[0], Video)
    envs = VectorPixelEnv(one.env, 2)
    _, timestep = envs.reset(jax.random.key(EPISODES), one.params)
    sky = np.asarray(timestep.obs)[:, 0, :, :3]
    firsts = made.bank.first[list(made.splits["test"])[:2]]
    assert np.array_equal(sky, made.bank.frames[firsts, 0])
    assert np.asarray(timestep.info["video_frame"]).tolist() == [0, 0]


@pytest.mark.parametrize(
    ("suite", "task", "clips", "message"),
    [
        ("dmcgb3", TASK, None, "unknown suite: 'dmcgb3'. Did you mean 'dmcgb'?"),
        ("dmcgb2", "ant", None, "no levels for task 'ant', only for tasks of dmc_walker, "),
        ("subtle", "ant", None, "no levels for task 'ant', only for dmc_ball_in_cup_catch, "),
        ("tiny", TASK, "procedural", "suite 'tiny' shows no video; leave out clips='procedural'"),
    ],
)
def test_a_suite_without_levels_is_told(suite, task, clips, message):
    with pytest.raises(ValueError, match=message.replace("?", r"\?")):
        levels(suite, clips=clips, config=EnvConfig(task=task))


def test_missing_clips_are_told_with_their_place(tmp_path):
    with pytest.raises(FileNotFoundError, match="shows videos: give their folder"):
        levels("dmcgb")
    with pytest.raises(FileNotFoundError, match=r"Wanted: video_easy or test\."):
        levels("dmcgb", clips=tmp_path / "clips")
    (tmp_path / "video_easy").mkdir()
    with pytest.raises(ValueError, match="has neither videos"):
        levels("dmcgb", clips=tmp_path)


def test_a_level_that_cannot_be_made_is_told():
    with pytest.raises(ValueError, match="'color-easy' of suite 'dmcgb' cannot be made for task"):
        levels("dmcgb", clips="procedural", config=EnvConfig(task="gym_hopper", **TINY))


@pytest.mark.parametrize(
    ("suite", "options", "message"),
    [
        ("axes", {"camera": ("front", "top")}, "'camera' moves one camera, but there are 2"),
        ("dmcgb2", {"obs_mode": "depth+state"}, "obs_mode='depth.state' shows none; add pixels"),
    ],
)
def test_what_changes_nothing_that_is_seen_is_refused(suite, options, message):
    with pytest.raises(ValueError, match=message):
        levels(suite, clips="procedural", config=EnvConfig(task=TASK, **TINY, **options))


def test_other_clips_that_are_shown_are_told():
    told = []
    levels("paper", clips="procedural", report=told.append)
    assert told == ["clips of split 'test' of procedural are shown for 'paper-test'"]
