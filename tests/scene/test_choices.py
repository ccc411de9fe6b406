"""Names of looks and rigs, and what a task's own model adds to them."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from pixelbrax_jax import EnvConfig, list_envs, make_look, make_rig, register
from pixelbrax_jax.envs import making
from pixelbrax_jax.scene.cameras import choose_rig, with_sides
from pixelbrax_jax.types import Lamp
from tests.envs.toy import Ball

OWN = {
    "default": make_rig((0, -3, 1), (0, 0, 1), 45.0, link=2, track=(1.0, 1.0, 1.0)),
    "side": make_rig((0, -2, 1), (0, 0, 1), 30.0),
    "back": make_rig((-2, 0, 1), (0, 0, 1), 60.0),
}


DARK = Lamp(-1, 0, np.full(3, np.nan), np.array([0, 0, -1]), *np.zeros(3, np.float32))


def test_a_models_own_look_is_the_default_one():
    own = make_look("dmc").replace(ambient=np.float32(0.7))

    class Lit(Ball):
        look = own

    def chosen(look, **options):
        config = EnvConfig("ball", look=look, **options)
        return making._look(config, Lit(), 45.0)

    for look in ("default", "dmc", "dmc-plain"):
        jax.tree.map(np.testing.assert_array_equal, chosen(look), own)
    assert chosen("original") is make_look("original")
    assert chosen("dmc", shadows=False).ambient == np.float32(0.7)
    assert making._look(EnvConfig("ball"), Ball(), 45.0) is make_look("default")


def test_a_model_has_a_plain_look_and_a_detailed_one():
    """The detailed one is for the rays of the picture."""
    pixels = []

    class Lit(Ball):
        look = make_look("dmc").replace(ambient=np.float32(0.7))

        def detailed_look(self, pixel):
            pixels.append(pixel)
            return self.look.replace(opengl=True)

    for name, detailed in (("dmc", True), ("dmc-plain", False), ("default", False)):
        config = EnvConfig("ball", look=name, height=50, samples=4)
        look = making._look(config, Lit(), 90.0)
        assert look.ambient == np.float32(0.7)
        assert look.opengl == detailed
    assert pixels == [pytest.approx(2.0 / 100)]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"ground": "stripes"}, "unknown ground of a Look: 'stripes'; allowed: checker, grid"),
        ({"shininess": 0}, "shininess of a Look must be a positive integer, got 0"),
        ({"ambient": np.nan}, r"ambient of a Look must have finite numbers of shape \(\), got nan"),
        ({"sky": np.ones((4, 3))}, r"sky of a Look .* shape \(2, 3\) or \(3, 3\), got"),
        ({"ambient": None}, "ambient of a Look must have finite numbers"),
        ({"lamps": (DARK,)}, r"pos of a Lamp must have finite numbers of shape \(3,\), got"),
        ({"ground_rgb": "red"}, r"ground_rgb of a Look .* of shape \(2, 3\), got 'red'"),
        ({"ambient": "0.5"}, r"ambient of a Look .* finite numbers of shape \(\), got '0.5'"),
        ({"ambient": 1e39}, "ambient of a Look must have finite numbers"),
        ({"ground_pitch": 0.0}, "ground_pitch of a Look must be a positive number, got 0"),
        ({"light": np.zeros(3)}, "light of a Look must not have length 0; None is for no such"),
        ({"sky_texture": np.full((2, 2), np.nan)}, r"sky_texture of a Look .* \(6, 2, 2, 3\)"),
        ({"opengl": "no"}, "opengl of a Look must be True or False, got 'no'"),
        ({"lamps": None}, "lamps of a Look must be a tuple of Lamp, got None"),
        ({"lamps": (None,)}, "lamps of a Look must be a tuple of Lamp, got None in it"),
        ({"lamps": (DARK.replace(exponent="x"),)}, "exponent of a Lamp must be a whole number"),
        ({"lamps": (DARK.replace(link=-2),)}, r"link of a Lamp .* at least -1 \(none\), got -2"),
    ],
)
def test_a_look_that_cannot_be_rendered(changes, told):
    with pytest.raises((ValueError, TypeError), match=told):
        make_look(make_look("default").replace(**changes))


def test_plain_numbers_become_arrays():
    sky = [[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]]
    look = make_look(make_look("default").replace(sky=sky, ambient=1))
    assert look.sky.shape == (2, 3)
    assert (look.sky.dtype, look.ambient.dtype) == (np.float32, np.float32)
    rig = choose_rig("ball", OWN["default"].replace(eye=(0.0, -3.0, 1.0)), OWN)
    np.testing.assert_array_equal(rig.eye, np.float32([0, -3, 1]))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"eye": (0.0, np.nan, 1.0)}, r"eye of a CameraRig .* finite numbers of shape \(3,\)"),
        ({"target": (0.0, 1.0)}, r"target of a CameraRig .* of shape \(3,\), got \(0.0, 1.0\)"),
        ({"fovy": np.nan}, "fovy of a CameraRig must have finite numbers"),
        ({"fovy": 200.0}, "fovy must lie between 0 and 180 degrees, got 200"),
        ({"link": -7}, r"link of a CameraRig .* of at least -1 \(none\), got -7"),
        ({"link": 1.5}, r"link of a CameraRig must be a whole number .*, got 1.5"),
        ({"link": None}, r"link of a CameraRig must be a whole number .*, got None"),
        ({"eye": OWN["default"].target}, "cannot look at"),
        ({"up": OWN["default"].target - OWN["default"].eye}, "'up' must not be parallel"),
    ],
)
def test_a_camera_that_sees_nothing(changes, told):
    with pytest.raises(ValueError, match=told):
        choose_rig("ball", OWN["default"].replace(**changes), OWN)


def test_dmcs_look_is_the_suites():
    """Colors and headlight of common/materials.xml, skybox.xml and visual.xml."""
    look = make_look("dmc")
    np.testing.assert_allclose(look.ground_rgb * 255, [[25, 51, 76], [51, 76, 102]], atol=1)
    assert (look.ambient, look.headlight) == (np.float32(0.4), np.float32(0.8))
    horizon, above, below = look.sky
    np.testing.assert_allclose(horizon, [0.2, 0.3, 0.4], atol=0.02)
    np.testing.assert_allclose(above, [0.4, 0.6, 0.8], atol=0.04)
    assert below.max() <= 0.05


def test_cameras_of_a_model_are_rigs_by_name():
    rigs = with_sides(OWN)
    assert list(rigs) == ["default", "side", "front", "top", "back"]
    for name, own in OWN.items():
        assert rigs[name] is own
    assert choose_rig("a task", "back", rigs) is OWN["back"]
    with pytest.raises(ValueError, match=r"unknown camera of task 'a task': 'bakc'.*mean 'back'"):
        choose_rig("a task", "bakc", rigs)


def test_a_task_with_a_camera_of_another_kind_is_not_registered():
    with pytest.raises(TypeError, match="camera must be a CameraRig, a Camera or None, got 'side'"):
        register("a task", lambda: None, camera="side")
    assert "a task" not in list_envs()
