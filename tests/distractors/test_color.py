"""The color distractor: its statistics, and what it changes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import distractors
from tests.distractors.conftest import episode, walk
from tests.envs.toy import PARAMS

KEYS = jax.vmap(jax.random.key)(jnp.arange(20_000))


def starts(color):
    return np.asarray(jax.jit(jax.vmap(lambda key: color.reset(key, PARAMS)))(KEYS))


@pytest.mark.parametrize("scale", [0.1, 0.3])
def test_normal_offsets(scale):
    shifts = starts(distractors.Color(scale=scale))
    assert shifts.shape == (20_000, 3)
    np.testing.assert_allclose(shifts.mean(0), 0.0, atol=4 * scale / np.sqrt(20_000))
    np.testing.assert_allclose(shifts.std(0), scale, rtol=0.02)
    # Channels are independent, and there are large shifts: nothing wraps or saturates.
    assert np.abs(np.corrcoef(shifts.T)[np.triu_indices(3, 1)]).max() < 0.03
    assert np.abs(shifts).max() > 3.5 * scale


def test_uniform_offsets():
    shifts = starts(distractors.Color(scale=0.2, distribution="uniform"))
    np.testing.assert_allclose(shifts.std(0), 0.2 / np.sqrt(3), rtol=0.02)
    assert np.abs(shifts).max() <= 0.2


def test_iid_frames_are_independent():
    shifts = walk(distractors.Color(scale=0.3), PARAMS, steps=50, num=500)
    np.testing.assert_allclose(shifts.std(), 0.3, rtol=0.02)
    correlation = np.corrcoef(shifts[:-1].ravel(), shifts[1:].ravel())[0, 1]
    assert abs(correlation) < 0.02


def test_a_static_color_stays():
    shifts = walk(distractors.Color(scale=0.3, dynamics="static"), PARAMS, steps=10, num=500)
    assert (shifts == shifts[0]).all()
    assert len(np.unique(shifts[0, :, 0])) == 500


def test_a_walk_takes_small_steps_and_stays_in_its_box():
    shifts = walk(distractors.Color(scale=0.2, dynamics="walk"), PARAMS, steps=2000, num=50)
    assert np.abs(shifts).max() <= 0.2 + 1e-6
    steps = np.diff(shifts, axis=0)
    inside = np.abs(shifts[:-1]) < 0.15
    np.testing.assert_allclose(steps[inside].std(), 0.03 * 0.2, rtol=0.03)
    # It gets about.
    assert (shifts.max(0) - shifts.min(0)).mean() > 0.2


def test_paper_color_is_one_offset_for_each_frame():
    (color,) = distractors.preset("paper-color", "ant")
    offsets = []
    for (timestep, frame, _), (_, clean, _) in zip(
        episode(color, 4), episode(None, 4), strict=True
    ):
        offset = np.asarray(timestep.info["color"])
        offsets.append(offset)
        for c, (plane, bare) in enumerate(
            ((frame.r, clean.r), (frame.g, clean.g), (frame.b, clean.b))
        ):
            np.testing.assert_allclose(plane, np.clip(bare + offset[c], 0, 1), atol=1e-6)
        # The uint8 path rounds the same image.
        levels = np.floor(np.stack([frame.r, frame.g, frame.b], -1) * 255 + 0.5)
        np.testing.assert_allclose(timestep.obs[..., -3:], levels, atol=1)
        assert (np.asarray(timestep.obs[..., -3:]) != levels).mean() < 1e-3
    assert len({tuple(offset) for offset in offsets}) == len(offsets)


@pytest.mark.parametrize("dynamics", ["iid", "walk", "static"])
@pytest.mark.parametrize("distribution", ["normal", "uniform"])
def test_materials_keep_colors_in_range(dynamics, distribution):
    color = distractors.Color("geom", dynamics, 0.6, distribution)
    shifts = walk(color, PARAMS, steps=20, num=200)
    assert shifts.shape[-2:] == PARAMS.geoms.rgb.shape
    rgb = (PARAMS.geoms.rgb + shifts)[..., 1, :]
    assert rgb.min() >= 0.0
    assert rgb.max() <= 1.0 + 1e-6
    # Each material of its own.
    assert abs(np.corrcoef(shifts[0, :, 0, 2], shifts[0, :, 1, 2])[0, 1]) < 0.3


def test_geom_colors_change_things_and_not_the_sky():
    color = distractors.Color("geom", "static", 0.3, "uniform")
    for (_, frame, _), (_, clean, _) in zip(episode(color, 4), episode(None, 4), strict=True):
        sky, ball = clean.seg == -1, clean.seg == 1
        np.testing.assert_array_equal(frame.r[sky], clean.r[sky])
        assert (np.asarray(frame.g)[ball] != np.asarray(clean.g)[ball]).all()
        assert (np.asarray(frame.g)[clean.ground] != np.asarray(clean.g)[clean.ground]).any()


def test_the_ground_has_room_of_its_own():
    """A plane's own color is not shown: white as it may be, the ground lightens and darkens."""
    white = PARAMS.geoms.rgb.copy()
    white[0] = 1.0
    params = PARAMS.replace(geoms=PARAMS.geoms.replace(rgb=white))
    for distribution in ("uniform", "normal"):
        color = distractors.Color("geom", "static", 0.2, distribution)
        shifts = np.asarray(jax.jit(jax.vmap(lambda key, c=color: c.reset(key, params)))(KEYS))
        assert abs((shifts[:, 0] > 0).mean() - 0.5) < 0.02
        if distribution == "uniform":
            assert (shifts != 0).all(), "nothing piles up on a bound"
        changed = jax.jit(jax.vmap(lambda s, c=color: c.change_params(s, params)))(shifts[:500])
        assert np.min(changed.look.ground_rgb) >= 0.0
        assert np.max(changed.look.ground_rgb) <= 1.0
        assert np.max(changed.geoms.rgb) <= 1.0


def test_uniform_materials_are_uniform_in_the_room_they_have():
    color = distractors.Color("geom", "static", 0.3, "uniform")
    shifts = starts(color)[:, 1]
    rgb = PARAMS.geoms.rgb[1]
    low, high = np.maximum(-0.3, -rgb), np.minimum(0.3, 1 - rgb)
    np.testing.assert_allclose(shifts.mean(0), (low + high) / 2, atol=0.005)
    np.testing.assert_allclose(shifts.std(0), (high - low) / np.sqrt(12), rtol=0.02)


def test_the_sky_shifts_too():
    color = distractors.Color("geom", "static", 0.2, "normal", sky=True)
    three = np.concatenate([PARAMS.look.sky, np.zeros((1, 3), np.float32)])
    for sky, weights in ((PARAMS.look.sky, (1.0, 1.0)), (three, (0.5, 1.0, 0.0))):
        params = PARAMS.replace(look=PARAMS.look.replace(sky=sky))
        draw = jax.jit(jax.vmap(lambda key, p=params: color.reset(key, p)))
        shifts = np.asarray(draw(KEYS[:2000]))
        assert shifts.shape[1:] == (len(PARAMS.geoms.rgb) + 1, 3)
        assert (sky[1] + shifts[:, -1]).min() >= 0.0
        assert (sky[1] + shifts[:, -1]).max() <= 1.0 + 1e-6
        changed = color.change_params(shifts[0], params)
        expected = np.clip(sky + np.array(weights)[:, None] * shifts[0, -1], 0, 1)
        np.testing.assert_allclose(changed.look.sky, expected, atol=1e-6)
        np.testing.assert_allclose(changed.geoms.rgb, PARAMS.geoms.rgb + shifts[0, :-1], atol=1e-6)


def test_only_some_materials_shift():
    color = distractors.Color("geom", "static", 0.3, "uniform", materials=("skin",))
    for names, moves in ((("floor", "skin"), [False, True]), ((), [True, True])):
        params = PARAMS.replace(geoms=PARAMS.geoms.replace(material_name=names))
        shifts = np.asarray(color.reset(jax.random.key(0), params))
        assert (shifts != 0).any(axis=1).tolist() == moves


def test_the_ground_can_stay():
    color = distractors.Color("geom", "static", 0.3, ground=False)
    shifts = starts(color)[:100]
    plane = PARAMS.geoms.material[0]
    assert PARAMS.geoms.is_ground(0)
    assert (shifts[:, plane] == 0).all()
    assert (np.delete(shifts, plane, axis=1) != 0).all()
    changed = color.change_params(shifts[0], PARAMS)
    np.testing.assert_array_equal(changed.look.ground_rgb, PARAMS.look.ground_rgb)


@pytest.mark.parametrize("dynamics", ["static", "walk"])
def test_a_textured_ground_darkens(dynamics):
    """A channel of the Distracting Control Suite's white material is uniform in [1 - b, 1]."""
    color = distractors.Color("geom", dynamics, 0.3, "uniform", ground="texture")
    shifts = starts(color)[:, PARAMS.geoms.material[0]]
    assert shifts.min() >= -0.3
    assert shifts.max() <= 0.0
    np.testing.assert_allclose(shifts.mean(0), -0.15, atol=0.003)
    np.testing.assert_allclose(shifts.std(0), 0.3 / np.sqrt(12), rtol=0.02)
    states = walk(color, PARAMS, steps=20, num=20)[-1]
    for state in states:
        changed = color.change_params(state, PARAMS).look.ground_rgb
        factor = 1 + state[PARAMS.geoms.material[0]]
        np.testing.assert_allclose(changed, PARAMS.look.ground_rgb * factor, rtol=1e-6)
        assert ((factor >= 0.7 - 1e-6) & (factor <= 1)).all()


def test_materials_that_a_model_has_not():
    color = distractors.Color("geom", "static", 0.3, "uniform", materials=("gird",))
    params = PARAMS.replace(geoms=PARAMS.geoms.replace(material_name=("floor", "skin")))
    with pytest.raises(
        ValueError, match=r"none of materials=\('gird',\) of Color; it has: floor, skin"
    ):
        color.reset(jax.random.key(0), params)


def test_plain_planes_are_no_ground():
    """The first plane with the pattern decides the ground's shift, not a wall before it."""
    geoms = PARAMS.geoms
    geoms = geoms.replace(
        kind=(geoms.kind[0], geoms.kind[0]), bounded=(True, True), patterned=(False, True)
    )
    color = distractors.Color("geom", "static", 0.3, "uniform")
    shift = jnp.array([[0.3, 0.3, 0.3], [0.1, 0.0, -0.1]])
    changed = color.change_params(shift, PARAMS.replace(geoms=geoms))
    expected = PARAMS.look.ground_rgb + shift[1]
    np.testing.assert_allclose(changed.look.ground_rgb, expected, atol=1e-6)
