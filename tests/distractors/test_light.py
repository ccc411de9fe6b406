"""Lights of an episode, against formulas in NumPy and images."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import pixelbrax_jax as pb
from pixelbrax_jax.distractors import Light
from pixelbrax_jax.scene.look import make_look
from pixelbrax_jax.types import Lamp
from tests.distractors.conftest import episode
from tests.envs.toy import PARAMS

LAMP = Lamp(
    link=-1,
    exponent=1,
    pos=np.float32([0.3, -0.2, 2]),
    axis=np.float32([0, 0, -1]),
    cos_cutoff=np.float32(0.7),
    diffuse=np.float32(0.5),
    highlight=np.float32(0.1),
)
LIT = PARAMS.replace(
    look=make_look("default").replace(light=np.float32([0, 0, 1]), lamps=(LAMP,)),
)


def lights(distractor, number=400):
    """States and parameters of ``number`` episodes."""
    keys = jax.random.split(jax.random.key(3), number)
    states = jax.vmap(lambda key: distractor.reset(key, LIT))(keys)
    changed = jax.vmap(lambda state: distractor.change_params(state, LIT))(states)
    return jax.tree.map(np.asarray, (states, changed))


def test_light_turns_within_the_angle():
    state, changed = lights(Light(direction=30.0, intensity=0.0, color=0.0))
    light, rig = changed.look.light, LIT.rig
    np.testing.assert_allclose(np.arccos(light[:, 2]), state.angle, atol=1e-3)
    assert 0 < np.degrees(state.angle).min() < 1
    assert 29 < np.degrees(state.angle).max() < 30
    # The horizontal part of the light is at right angles to the axis.
    along = light[:, 0] * np.cos(state.azimuth) + light[:, 1] * np.sin(state.azimuth)
    np.testing.assert_allclose(along, 0.0, atol=1e-6)
    assert np.ptp(state.azimuth) > 6.2
    # A spot light keeps its distance from the camera's target, and looks where it looked.
    before, after = LAMP.pos - rig.target, changed.look.lamps[0].pos - rig.target
    np.testing.assert_allclose(
        np.linalg.norm(after, axis=1), np.linalg.norm(before), rtol=1e-5, atol=1e-6
    )
    np.testing.assert_allclose(
        (after * changed.look.lamps[0].axis).sum(1), before @ LAMP.axis, rtol=1e-4, atol=1e-5
    )


def test_light_has_another_intensity_and_color():
    state, changed = lights(Light(direction=0.0, intensity=0.5, color=0.2))
    for factors, amount in ((state.intensity, 0.5), (state.color, 0.2)):
        assert 1 - amount <= factors.min() < 1 - 0.97 * amount
        assert 1 + 0.97 * amount < factors.max() <= 1 + amount
        assert factors.mean() == pytest.approx(1.0, abs=0.05)
    for name in ("ambient", "diffuse"):
        found, before = getattr(changed.look, name), getattr(LIT.look, name)
        np.testing.assert_allclose(found, before * state.intensity, rtol=1e-6)
    np.testing.assert_allclose(changed.look.lamps[0].diffuse, 0.5 * state.intensity, rtol=1e-6)
    rgb = np.clip(np.asarray(LIT.geoms.rgb)[None] * state.color[:, None], 0.0, 1.0)
    np.testing.assert_allclose(changed.geoms.rgb, rgb, rtol=1e-6)
    np.testing.assert_allclose(changed.look.light, np.tile([0.0, 0.0, 1.0], (400, 1)), atol=1e-6)


def test_an_episode_keeps_its_light_and_no_change_is_none():
    frames = [(timestep.obs, timestep.info["light"]) for timestep, *_ in episode(Light(), 3)]
    clean, other = list(episode(None, 3)), list(episode(Light(), 3, key=1))
    for (pixels, light), (timestep, *_), (elsewhere, *_) in zip(frames, clean, other, strict=True):
        assert (pixels != timestep.obs).any()
        np.testing.assert_array_equal(light, frames[0][1])
        assert (light != elsewhere.info["light"]).all()
    none = Light(direction=0.0, intensity=0.0, color=0.0)
    for (same, *_), (timestep, *_) in zip(episode(none, 3), clean, strict=True):
        np.testing.assert_array_equal(same.obs, timestep.obs)


def test_the_lights_of_a_model_and_of_several_cameras_turn():
    options = {"height": 12, "width": 12, "camera": ("fixed", "top"), "distractors": "light"}
    env, params = pb.make("dmc_cartpole_swingup", engine="mujoco", **options)
    state, _ = env.reset(jax.random.key(0), params)
    look = env.chain.change_params(state.sim.distractor_state, params).look
    assert (look.lamps[0].pos != params.look.lamps[0].pos).all()
    assert look.lamps[0].diffuse != params.look.lamps[0].diffuse


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"direction": 181.0}, r"direction of Light must lie in \[0, 180\] degrees, got 181.0"),
        ({"direction": "40"}, "direction of Light must be a finite number, got '40'"),
        ({"intensity": 1.5}, r"intensity of Light must lie in \[0, 1\], got 1.5"),
        ({"color": -0.1}, r"color of Light must lie in \[0, 1\], got -0.1"),
    ],
)
def test_options_out_of_range_are_errors(options, message):
    with pytest.raises(ValueError, match=message):
        Light(**options)
