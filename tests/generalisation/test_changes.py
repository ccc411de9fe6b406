"""Changes of parameters against their formulas, in NumPy and degrees."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from pixelbrax_jax import make_look, make_rig
from pixelbrax_jax.generalisation import suites
from pixelbrax_jax.generalisation.changes import (
    NUM_VIEWS,
    BodyColor,
    LightColor,
    LightDirection,
    LightIntensity,
    Radius,
    Rotation,
    Shift,
)
from pixelbrax_jax.spatial import look_at
from pixelbrax_jax.types import Lamp
from tests.envs.toy import PARAMS

TILTED = PARAMS.replace(rig=make_rig((1.0, -4.0, 2.0), (0.5, 0.0, 0.3), 50.0))


def rows(change, num=NUM_VIEWS, params=TILTED):
    """The parameters of the first episodes."""
    keys = jax.random.split(jax.random.key(0), num)
    return jax.vmap(lambda key, i: change.change(params, key, i))(keys, np.arange(num))


def orientations(rig):
    return np.asarray(jax.vmap(look_at)(*(np.asarray(x) for x in (rig.eye, rig.target, rig.up))))


BEFORE = np.asarray(look_at(*map(np.asarray, (TILTED.rig.eye, TILTED.rig.target, TILTED.rig.up))))


def about(axis: str, degrees: float) -> np.ndarray:
    """The matrix of a rotation, right-handed."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array(
        {
            "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
            "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
            "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
        }[axis]
    )


def same_set(found: np.ndarray, expected: list[np.ndarray]) -> bool:
    """Whether each expected matrix is found exactly once."""
    far = np.abs(found[:, None] - np.array(expected)[None]).max(axis=(2, 3))
    return np.array_equal((far < 1e-5).sum(0), np.ones(len(expected)))


@pytest.mark.parametrize("degrees", [180.0, 90.0])
def test_the_camera_turns_by_a_hundred_even_angles(degrees):
    rig = rows(Rotation(degrees)).rig
    angles = np.linspace(-degrees, degrees, 100, endpoint=False)
    assert same_set(orientations(rig), [BEFORE @ about("z", angle) for angle in angles])
    assert np.array_equal(rig.eye, np.tile(TILTED.rig.eye, (100, 1)))
    np.testing.assert_allclose(rig.target, np.tile(TILTED.rig.target, (100, 1)), atol=1e-5)


def test_the_camera_shifts_along_a_rectangle():
    corners = [(-6, -6), (6, -6), (6, 12), (-6, 12)]
    angles = [
        np.array(one) + (np.array(other) - one) * step / 25
        for one, other in zip(corners, corners[1:] + corners[:1], strict=True)
        for step in range(25)
    ]
    shift = suites._CORNERS["dmc_finger"]
    expected = [BEFORE @ about("y", y) @ about("x", x) for y, x in angles]
    assert same_set(orientations(rows(shift).rig), expected)


def test_the_camera_shifts_first_and_then_turns():
    shift, rotation = Shift((-10.0, 10.0), (-8.0, 8.0)), Rotation(180.0)
    key, episode = jax.random.key(0), 7
    shifted = shift.change(TILTED, key, episode)
    both = rotation.change(shifted, key, episode)
    one, two = (
        np.asarray(look_at(params.rig.eye, params.rig.target, params.rig.up))
        for params in (shifted, both)
    )
    angle = -180.0 + 3.6 * (61 * episode % 100)
    np.testing.assert_allclose(two, one @ about("z", angle), atol=1e-5)
    # The pairs of both are a hundred different ones.
    places = [(61 * i % 100, 47 * i % 100) for i in range(100)]
    assert [len(set(numbers)) for numbers in zip(*places, strict=True)] == [100, 100]


def test_lights_turn_by_an_angle():
    lamp = Lamp(
        link=0,
        exponent=1,
        pos=np.float32([0, 0, 2]),
        axis=np.float32([0, 0, -1]),
        cos_cutoff=np.float32(0.7),
        diffuse=np.float32(0.5),
        highlight=np.float32(0.1),
    )
    look = make_look("default").replace(light=np.float32([0, 0, 1]), lamps=(lamp,))
    turned = rows(LightDirection(20.0), 50, TILTED.replace(look=look)).look
    np.testing.assert_allclose(turned.light[:, 2], np.cos(np.radians(20.0)), rtol=1e-5)
    np.testing.assert_allclose(turned.lamps[0].pos, 2 * turned.light, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(turned.lamps[0].axis, -turned.light, rtol=1e-5, atol=1e-6)
    assert np.ptp(np.arctan2(turned.light[:, 1], turned.light[:, 0])) > 5, "any azimuth"


def test_light_is_darker_or_brighter():
    look = rows(LightIntensity(0.4), 60).look
    factors = np.asarray(look.diffuse, float) / TILTED.look.diffuse
    assert set(np.round(factors, 4).tolist()) == {0.6, 1.4}
    np.testing.assert_allclose(look.ambient / TILTED.look.ambient, factors, rtol=1e-6)


def test_light_has_another_color():
    changed = rows(LightColor(0.2))
    rgb, ground = np.asarray(TILTED.geoms.rgb), np.asarray(TILTED.look.ground_rgb)
    seen = rgb[(rgb > 0.0).all(1) & (rgb < 1 / 1.2).all(1)][0]
    of_seen = [list(row) for row in rgb].index(list(seen))
    factor = np.asarray(changed.geoms.rgb)[:, of_seen] / seen
    assert 0.8 <= factor.min() < 0.83
    assert 1.17 < factor.max() < 1.2 + 1e-6
    assert (np.ptp(factor, axis=1) > 0).all()
    for found, before in ((changed.geoms.rgb, rgb), (changed.look.ground_rgb, ground)):
        expected = np.clip(before[None] * factor[:, None], 0.0, 1.0)
        np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_the_body_alone_has_other_colors():
    params = rows(BodyColor(0.1), 400)
    before, after = TILTED.geoms.rgb, np.asarray(params.geoms.rgb)
    assert np.array_equal(after[:, 0], np.tile(before[0], (400, 1))), "material of the plane"
    # The middle channel is 0.3, three deviations from the bounds.
    assert np.std(after[:, 1, 1]) == pytest.approx(0.1, rel=0.1)
    assert after.min() >= 0
    assert after.max() <= 1


def test_a_radius_is_that_of_the_image_alone():
    size = np.asarray(rows(Radius(0.25, ("ball",)), 2).geoms.size)
    np.testing.assert_allclose(size[0], [[0, 0, 1], [0.075, 0, 0]], rtol=1e-6)
    with pytest.raises(ValueError, match="the task has no geom pole; it has ground, ball"):
        Radius(0.5, ("pole",)).change(TILTED, jax.random.key(0), 0)
