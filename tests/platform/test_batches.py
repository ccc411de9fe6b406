"""Rows that are computed in chunks are those that are computed together, and by ``jax.vmap``."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pixelbrax_jax as pb
from pixelbrax_jax._platform import batches
from pixelbrax_jax._platform.batches import chunk_size, draw_rows, map_runs, step_rows
from pixelbrax_jax.envs.param_rows import split_params


@pytest.mark.parametrize(
    ("num_rows", "size"),
    [(1, 1), (100, 100), (128, 128), (130, 65), (256, 128), (257, 257), (1000, 125), (8192, 128)],
)
def test_a_chunk_is_the_largest_divisor_within_bounds(num_rows, size):
    assert chunk_size(num_rows) == size


def step(state, row, shared):
    """Rows of two arrays, one of them empty, as some engines carry."""
    x = jnp.tanh(state["x"] @ shared + row)
    return {"x": x, "empty": state["empty"]}, x.sum()


@pytest.mark.parametrize("num_rows", [1, 6, 7])
def test_chunks_give_what_the_whole_gives(num_rows, monkeypatch):
    keys = jax.random.split(jax.random.key(num_rows), 3)
    state = {"x": jax.random.normal(keys[0], (num_rows, 3)), "empty": jnp.zeros((num_rows, 0))}
    row, shared = jax.random.normal(keys[1], (num_rows, 3)), jax.random.normal(keys[2], (3, 3))
    expected = jax.jit(jax.vmap(step, in_axes=(0, 0, None)))(state, row, shared)
    for largest in (128, 4, 3, 1):
        monkeypatch.setattr(batches, "_CHUNK", largest)
        actual = jax.jit(partial(step_rows, step))(state, row, shared)
        for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
            assert a.shape == b.shape
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("platform", "loops"), [("cpu", 1), ("cuda", 0)])
def test_only_a_cpu_has_a_loop_over_chunks(platform, loops):
    states, rows = jnp.zeros((256, 3)), jnp.zeros((256, 3))

    def put(states, rows):
        moved, sums = step_rows(step, {"x": states, "empty": states[:, :0]}, rows, jnp.eye(3))
        return moved["x"], sums

    text = jax.jit(put).trace(states, rows).lower(lowering_platforms=(platform,)).as_text()
    assert text.count("stablehlo.while") == loops


@pytest.mark.parametrize("num_rows", [1, 6, 7])
@pytest.mark.parametrize("rays", [4, 10, 21, 100])
def test_images_in_turns_are_those_of_all_together(num_rows, rays, monkeypatch):
    monkeypatch.setattr(batches, "_RAYS", 21)
    keys = jax.random.split(jax.random.key(0), num_rows)

    def draw(key, shade):
        return {"a": jax.random.uniform(key, (2, 5)) * shade, "b": jnp.int32(shade)}

    shades = jnp.arange(num_rows) + 1.0
    found = jax.jit(lambda *rows: draw_rows(draw, rows, rays))(keys, shades)
    jax.tree.map(np.testing.assert_array_equal, found, jax.jit(jax.vmap(draw))(keys, shades))


@pytest.mark.parametrize(
    ("num_rows", "rays", "turns"), [(7, 7, 3), (10, 18, 5), (10, 8, 4), (128, 9, 43), (3, 7, 0)]
)
def test_no_turn_draws_again_what_others_drew(num_rows, rays, turns, monkeypatch):
    monkeypatch.setattr(batches, "_RAYS", 21)
    loops = []

    def counted(first, last, body, carry):
        loops.append(last - first)
        return carry

    monkeypatch.setattr(batches.jax.lax, "fori_loop", counted)
    jax.jit(lambda x: draw_rows(jnp.sin, (x,), rays)).lower(jnp.zeros(num_rows))
    assert sum(loops) == turns


@pytest.mark.parametrize(("look", "loops"), [("dmc", 1), ("default", 0)])
def test_only_images_of_several_are_drawn_in_turns(look, loops, monkeypatch):
    monkeypatch.setattr(batches, "_RAYS", 3 * 8 * 8)
    env, params = pb.make("dmc_cartpole_swingup", height=8, width=8, look=look)
    envs = pb.VectorPixelEnv(env, 7)
    state, _ = jax.eval_shape(envs.reset, jax.random.key(0), params)

    def push(frames, sim):
        return envs._push_frames(frames, sim, split_params(params, 7), jnp.ones(7, bool))

    traced = jax.jit(push).trace(state.frames, state.sim)
    assert traced.lower(lowering_platforms=("cpu",)).as_text().count("stablehlo.while") == loops


def test_runs_are_mapped_one_after_the_other_on_a_cpu():
    runs = jnp.arange(6.0).reshape(3, 2)
    np.testing.assert_array_equal(map_runs(lambda run: run * 2.0, runs), runs * 2.0)
