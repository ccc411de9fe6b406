"""The camera distractor: its box, its walk, and what is still in view."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import distractors, make
from pixelbrax_jax.physics.brax.loading import rigs_of
from pixelbrax_jax.scene.cameras import aim, with_sides
from pixelbrax_jax.scene.place import place
from pixelbrax_jax.spatial import make_rig
from pixelbrax_jax.tasks import BRAX_TASKS
from tests.distractors.conftest import walk
from tests.envs.toy import PARAMS

SCALES = {"easy": 0.1, "medium": 0.2, "hard": 0.3}
RIG = make_rig((0.0, -4.0, 1.0), (0.0, 0.0, 0.0), 50.0)
STEPS = 10_000


def eye_of(camera, state, params):
    """World positions of the cameras, (..., 3)."""

    def one(state):
        return camera.change_params(state, params).rig.eye

    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), state)
    return np.asarray(jax.jit(jax.vmap(one))(flat)).reshape(*state.radius.shape, 3)


@pytest.mark.parametrize(
    "level", ["hard", *(pytest.param(name, marks=pytest.mark.slow) for name in ("easy", "medium"))]
)
def test_the_walk_stays_in_its_box(level):
    b = SCALES[level]
    params = PARAMS.replace(rig=RIG)
    camera = distractors.MovingCamera(scale=b)
    states = walk(camera, params, STEPS, num=8)
    angle, tiny = 0.5 * np.pi * b, 1e-5
    polar = np.arctan2(4.0, 1.0)
    assert states.radius.min() >= 1 - 0.5 * b - tiny
    assert states.radius.max() <= 1 + 1.5 * b + tiny
    for name in ("azimuth", "roll"):
        assert np.abs(getattr(states, name)).max() <= angle + tiny
    assert states.polar.min() >= -angle - tiny
    assert states.polar.max() <= min(angle, 0.5 * np.pi - polar) + tiny
    # It gets about.
    assert np.ptp(states.azimuth, axis=0).min() > angle
    assert np.ptp(states.radius, axis=0).min() > 0.5 * b
    eyes = eye_of(camera, jax.tree.map(lambda x: x[::50], states), params)
    assert eyes[..., 2].min() >= -tiny, "above the point it looks at"
    distance = np.linalg.norm(eyes, axis=-1) / np.linalg.norm(RIG.eye)
    np.testing.assert_allclose(distance, states.radius[::50], rtol=1e-4)


@pytest.mark.parametrize("b", [0.1, 0.3])
def test_the_walk_keeps_its_speed_limits(b):
    params = PARAMS.replace(rig=RIG)
    states = walk(distractors.MovingCamera(scale=b), params, 3000, num=8)
    fastest = 0.4 * b * np.linalg.norm(RIG.eye) / 4.0
    speed = np.linalg.norm(states.velocity, axis=-1)
    # Where the box cuts a step short it may also turn it, never lengthen it by much.
    assert np.quantile(speed, 0.99) <= fastest + 1e-5
    assert np.abs(states.roll_velocity).max() <= np.pi * b / 50 + 1e-6
    np.testing.assert_allclose(np.diff(states.roll, axis=0), states.roll_velocity[1:], atol=1e-5)


def test_velocities_are_on_a_random_walk():
    """Far from the box, steps of the velocity have the standard deviation that is documented."""
    b = 0.3
    params = PARAMS.replace(rig=RIG)
    camera = distractors.MovingCamera(scale=b)
    middle = jnp.float32
    still = camera.reset(jax.random.key(0), params).replace(
        radius=middle(1.2),
        azimuth=middle(0.0),
        polar=middle(-0.1),
        roll=middle(0.0),
        velocity=jnp.zeros(3),
        roll_velocity=middle(0.0),
    )
    keys = jax.vmap(jax.random.key)(jnp.arange(4000))
    after = jax.jit(jax.vmap(lambda key: camera.advance(still, key, 1, params)))(keys)
    scaling = float(np.linalg.norm(RIG.eye)) / 4.0
    np.testing.assert_allclose(np.asarray(after.velocity).std(0), 0.1 * b * scaling, rtol=0.05)
    np.testing.assert_allclose(np.asarray(after.roll_velocity).std(), np.pi * b / 300, rtol=0.05)


def test_starts_are_uniform_in_the_box():
    camera, params = distractors.MovingCamera(scale=0.2, dynamic=False), PARAMS.replace(rig=RIG)
    keys = jax.vmap(jax.random.key)(jnp.arange(20_000))
    states = jax.jit(jax.vmap(lambda key: camera.reset(key, params)))(keys)
    angle = 0.1 * np.pi
    for values, low, high in (
        (states.radius, 0.9, 1.3),
        (states.azimuth, -angle, angle),
        (states.roll, -angle, angle),
    ):
        np.testing.assert_allclose(np.mean(values), (low + high) / 2, atol=0.01)
        np.testing.assert_allclose(np.std(values), (high - low) / np.sqrt(12), rtol=0.02)
    assert not np.asarray(states.velocity).any()
    later = camera.advance(jax.tree.map(lambda x: x[0], states), keys[0], 1, params)
    np.testing.assert_array_equal(later.radius, states.radius[0])


def test_nothing_moves_at_scale_zero():
    params = PARAMS.replace(rig=RIG)
    camera = distractors.MovingCamera(scale=0.0)
    states = walk(camera, params, 20, num=2)
    np.testing.assert_allclose(
        eye_of(camera, states, params), np.broadcast_to(RIG.eye, (19, 2, 3)), atol=1e-5
    )


DOWN = make_rig((0.3, 0.1, 0.75), (0.3, 0.1, 0.01), 45.0, up=(0.0, 1.0, 0.0))
"""As DM Control's reacher and point_mass are seen, and its fish from above."""


def test_a_camera_that_looks_straight_down():
    """It leaves the pole, keeps its subject in the middle, and does not turn upside down."""
    params, b = PARAMS.replace(rig=DOWN), 0.3
    camera = distractors.MovingCamera(scale=b)
    states = walk(camera, params, 500, num=4)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), states)
    none = jnp.zeros((1, 3))
    seen = jax.jit(jax.vmap(lambda state: aim(camera.change_params(state, params).rig, none)))(flat)
    away = np.asarray(seen.pos) - DOWN.target
    tilt = np.arccos(away[:, 2] / np.linalg.norm(away, axis=1))
    assert tilt.max() <= 0.5 * np.pi * b + 1e-3
    assert np.ptp(tilt) > 0.5 * b
    middle = np.einsum("ni,nij->nj", -away, seen.xmat)
    np.testing.assert_allclose(middle[:, :2], 0.0, atol=1e-4)
    # Its own up is +y; what is left of that after a roll of at most 27 degrees.
    assert np.asarray(seen.xmat)[:, 1, 1].min() > 0.5
    clean = jax.tree.map(jnp.zeros_like, jax.tree.map(lambda x: x[0], flat))
    undisturbed = aim(camera.change_params(clean.replace(radius=jnp.ones(())), params).rig, none)
    np.testing.assert_allclose(undisturbed.pos, DOWN.eye, atol=1e-6)
    np.testing.assert_allclose(undisturbed.xmat, np.eye(3), atol=1e-6)


# A rig from the side, from above, from near the pole, from beyond it, and from a corner.
@pytest.mark.parametrize(
    ("task", "name"),
    [
        ("walker2d", "default"),
        ("ant", "top"),
        ("reacher", "default"),
        ("inverted_pendulum", "default"),
        ("pusher", "default"),
    ],
)
def test_rigs_of_all_kinds_yield_sound_cameras(task, name):
    base = with_sides(rigs_of(BRAX_TASKS[task]))[name]
    params = PARAMS.replace(rig=base)
    camera = distractors.MovingCamera(scale=0.3)
    states = walk(camera, params, 200, num=4)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), states)
    xpos = jnp.zeros((12, 3))
    xmat = jax.jit(jax.vmap(lambda state: aim(camera.change_params(state, params).rig, xpos).xmat))(
        flat
    )
    identity = np.einsum("nij,nkj->nik", xmat, xmat)
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), identity.shape), atol=1e-4)
    assert (np.linalg.det(np.asarray(xmat)) > 0.99).all()


@pytest.mark.parametrize(
    "task",
    [
        task if task == "inverted_pendulum" else pytest.param(task, marks=pytest.mark.slow)
        for task in BRAX_TASKS
    ],
)
def test_the_agent_stays_in_view_at_the_easy_level(task):
    env, params = make(task, obs_mode="state")
    state, _ = env.reset(jax.random.key(0), params)
    camera = distractors.MovingCamera(scale=0.1)
    states = walk(camera, params, 2000, num=4)
    flat = jax.tree.map(lambda x: x[::20].reshape(-1, *x.shape[2:]), states)
    geoms = params.geoms
    moving = np.array([g for g, link in enumerate(geoms.link) if link >= 0])

    def centers_in_view(state_of_camera):
        """Which geom centers lie in the image."""
        rig = camera.change_params(state_of_camera, params).rig
        scene = place(geoms, rig, params.look, state.sim.physics.xpos, state.sim.physics.xquat)
        seen = (scene.pos[moving] - scene.camera.pos) @ scene.camera.xmat
        reach = jnp.tan(jnp.deg2rad(scene.camera.fovy) / 2) * -seen[:, 2:]
        return (jnp.abs(seen[:, :2]) < reach).all(-1) & (seen[:, 2] < 0)

    inside = np.asarray(jax.jit(jax.vmap(centers_in_view))(flat))
    assert inside.any(axis=1).all()
    assert inside.mean() > 0.8


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, 0.5, 0.866)])
def test_the_horizon_tilts_by_the_roll_alone(up):
    """Also with cameras whose own up direction is tilted, as those of DM Control that look down."""
    params = PARAMS.replace(rig=make_rig((0.0, -3.0, 1.0), (0.0, 0.0, 0.0), 50.0, up=up))
    camera = distractors.MovingCamera(scale=0.3)
    keys = jax.random.split(jax.random.key(0), 100)

    def tilt(key):
        state = camera.reset(key, params)
        xmat = aim(camera.change_params(state, params).rig, jnp.zeros((1, 3))).xmat
        # The world's vertical in the image.
        return jnp.arctan2(xmat[2, 0], xmat[2, 1]), state.roll, state.azimuth

    tilts, rolls, azimuths = jax.jit(jax.vmap(tilt))(keys)
    assert np.abs(azimuths).max() > 0.4
    np.testing.assert_allclose(tilts, rolls, atol=1e-5)


@pytest.mark.parametrize("height", [3.0, -3.0])
def test_a_camera_straight_above_or_below_keeps_its_up_direction(height):
    """There a change of azimuth moves it along one meridian or another, and turns no picture."""
    rig = make_rig((0.0, 0.0, height), (0.0, 0.0, 0.0), 50.0, up=(0.0, 1.0, 0.0))
    params = PARAMS.replace(rig=rig)
    camera = distractors.MovingCamera(scale=0.3, dynamic=False)
    state = camera.reset(jax.random.key(0), params).replace(
        radius=jnp.float32(1), azimuth=jnp.float32(0.5), polar=jnp.float32(0), roll=jnp.float32(0)
    )
    moved = aim(camera.change_params(state, params).rig, jnp.zeros((1, 3))).xmat
    np.testing.assert_allclose(moved, aim(rig, jnp.zeros((1, 3))).xmat, atol=1e-5)


def test_roll_turns_the_picture():
    params = PARAMS.replace(rig=RIG)
    camera = distractors.MovingCamera(scale=0.3, dynamic=False)
    state = camera.reset(jax.random.key(0), params).replace(
        radius=jnp.float32(1), azimuth=jnp.float32(0), polar=jnp.float32(0), roll=jnp.float32(0.3)
    )
    plain = aim(RIG, jnp.zeros((1, 3))).xmat
    turned = aim(camera.change_params(state, params).rig, jnp.zeros((1, 3))).xmat
    np.testing.assert_allclose(turned[:, 2], plain[:, 2], atol=1e-5)
    cosine = float(turned[:, 1] @ plain[:, 1])
    np.testing.assert_allclose(cosine, np.cos(0.3), atol=1e-5)


def test_gradients_are_finite_straight_above():
    above = make_rig((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), 50.0, up=(0.0, 1.0, 0.0))
    camera = distractors.MovingCamera(scale=0.3)

    def place_of_eye(eye):
        params = PARAMS.replace(rig=above.replace(eye=eye))
        state = camera.reset(jax.random.key(0), params)
        state = camera.advance(state, jax.random.key(1), 1, params)
        return camera.change_params(state, params).rig.eye.sum()

    assert np.isfinite(jax.grad(place_of_eye)(jnp.asarray(above.eye))).all()
