"""What XLA makes of the ray-caster: the fusion and the threads that its speed rests on."""

import os
import re

import jax
import jax.numpy as jnp
import pytest

import pixelbrax_jax as pb

NUM_ENVS, SIZE = 64, 84


@pytest.fixture(scope="module")
def program():
    """Packed frames of 64 Ants."""
    env, params = pb.make("ant", height=SIZE, width=SIZE)
    keys = jax.random.split(jax.random.key(0), NUM_ENVS)
    begin = jax.jit(jax.vmap(lambda key: env.begin(key, jnp.uint32(0), params)))
    states = begin(keys).replace(key=None, frames=None)
    draw = jax.vmap(env.draw, in_axes=(0, None))
    return jax.jit(draw).lower(states, params).compile()


def test_no_plane_of_pixels_is_kept_for_a_geom(program):
    memory = program.memory_analysis()
    assert memory.output_size_in_bytes >= NUM_ENVS * SIZE * SIZE * 4
    assert memory.temp_size_in_bytes <= 1.25 * memory.output_size_in_bytes


def test_a_frame_costs_what_it_should(program):
    cost = program.cost_analysis()
    pixels = NUM_ENVS * SIZE * SIZE
    # Some 25 operations for each of 18 geoms, about as many again for shading them.
    assert cost["flops"] / pixels < 600
    # Words are written by the ray-caster, joined and turned: a few times four bytes.
    assert cost["bytes accessed"] / pixels < 40


def test_pixels_are_computed_in_one_fusion(program):
    # Each capsule takes two roots; were one fusion split or repeated, there were more.
    text = program.as_text()
    capsules = 13
    roots = len(re.findall(r"f32\[\d+,\d+,\d+\]\S* sqrt\(", text))
    assert 0 < roots <= 2 * 18 + 1, roots
    assert roots >= 2 * capsules


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_pixels_are_spread_over_the_cores(program):
    drawing = [
        line
        for line in program.as_text().splitlines()
        if re.search(r"= u32\[\d+,\d+,\d+\]\S* fusion\(", line) and "calls=" in line
    ]
    assert any('outer_dimension_partitions":["' in line for line in drawing), drawing
