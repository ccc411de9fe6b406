"""What an accelerator computes in another way than a CPU comes out the same."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax._platform import frame_stack, resets
from tests.envs.test_vector import ACTIONS, PARAMS, N, make


def lowered_for(platform: str, fn, *args) -> str:
    return jax.jit(fn).trace(*args).lower(lowering_platforms=(platform,)).as_text()


@pytest.mark.parametrize("cameras", [(), (2,)])
@pytest.mark.parametrize("stack", [1, 2, 3])
def test_frames_are_pushed_alike(stack, cameras):
    draw = np.random.default_rng(0)
    number = 2 if cameras else 1
    frames = draw.integers(0, 256, (N, 5, 7, 3 * stack * number), np.uint8)
    newest = draw.integers(0, 2**24, (N, *cameras, 5, 7), np.uint32)
    is_first = jnp.arange(N) % 2 == 0
    one, other = (
        jax.vmap(push)(frames, newest, is_first)
        for push in (frame_stack._concatenate, frame_stack._shift)
    )
    np.testing.assert_array_equal(one, other)
    # The newest frame comes last, red first, and the last camera's last.
    np.testing.assert_array_equal(other[..., -3], newest.reshape(N, -1, 5, 7)[:, -1] & 255)


@pytest.mark.parametrize("cameras", [(), (2,)])
def test_depths_are_pushed_alike(cameras):
    draw, number = np.random.default_rng(0), 2 if cameras else 1
    frames = draw.random((N, 5, 7, 3 * number), np.float32)
    newest = draw.random((N, *cameras, 5, 7), np.float32)
    is_first = jnp.arange(N) % 2 == 0
    one, other = (
        jax.vmap(push)(frames, newest, is_first)
        for push in (frame_stack._concatenate, frame_stack._shift)
    )
    np.testing.assert_array_equal(one, other)
    image = np.moveaxis(newest.reshape(N, -1, 5, 7), 1, -1)
    np.testing.assert_array_equal(other[..., -number:], image)
    np.testing.assert_array_equal(other[1, ..., :-number], frames[1, ..., number:])
    np.testing.assert_array_equal(other[0, ..., :number], image[0])


def test_environments_are_reset_alike():
    venv = make("next_step")
    state, _ = venv.reset(jax.random.key(0), PARAMS)
    for _ in range(3):
        state, _ = venv.step(state, ACTIONS, PARAMS)
    mask = jnp.array([False, True, True, False, True])

    def reset(key, episode):
        return venv.env.reset_sim(key, episode, PARAMS)

    arguments = (state.key, state.sim.episode + 1)
    one, other = (
        jax.jit(replace, static_argnums=0)(reset, arguments, mask, state.sim)
        for replace in (resets.replace_rows, resets._select_rows)
    )
    jax.tree.map(np.testing.assert_array_equal, one, other)
    np.testing.assert_array_equal(other.episode, mask)


def test_an_accelerator_does_not_wait_for_the_host_in_a_step():
    """A loop whose turns depend on data is read by the host in every turn."""
    venv = make("next_step")
    state, _ = venv.reset(jax.random.key(0), PARAMS)
    text = {
        platform: lowered_for(platform, venv.step, state, ACTIONS, PARAMS)
        for platform in ("cpu", "cuda")
    }
    assert "stablehlo.while" in text["cpu"]
    # The bands in which an image is drawn are counted.
    counted = make("next_step", obs_mode="state")
    state, _ = counted.reset(jax.random.key(0), PARAMS)
    assert "stablehlo.while" not in lowered_for("cuda", counted.step, state, ACTIONS, PARAMS)


def test_a_reset_that_tries_again_stays_with_the_rows_that_need_it():
    def reset(start):
        return jax.lax.while_loop(lambda x: x < 10.0, lambda x: x * 2.0, start)

    rows, mask = jnp.arange(1.0, 6.0), jnp.arange(5) < 2

    def put(rows, mask):
        return resets.reset_rows(reset, (rows,), mask, rows)

    np.testing.assert_array_equal(put(rows, mask), [16.0, 16.0, 3.0, 4.0, 5.0])
    text = lowered_for("cuda", put, rows, mask)
    assert text.count("stablehlo.while") == 2  # over blocks, and over attempts
