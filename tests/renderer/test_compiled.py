"""What XLA makes of the ray-caster: the fusion and the threads that its speed rests on."""

import os
import re

import jax
import jax.numpy as jnp
import pytest

import pixelbrax_jax as pb
from pixelbrax_jax.renderer.base import render
from tests.renderer.test_lamps import LAMP
from tests.renderer.test_planes import random_strip

NUM_ENVS, SIZE = 64, 84
PIXELS = NUM_ENVS * SIZE * SIZE

pytestmark = pytest.mark.skipif(
    jax.default_backend() != "cpu", reason="this is what XLA makes of it on a CPU"
)


@pytest.fixture(scope="module")
def ants():
    """Shapes of 64 Ants."""
    env, params = pb.make("ant", height=SIZE, width=SIZE)
    keys = jax.random.split(jax.random.key(0), NUM_ENVS)
    reset = jax.vmap(lambda key: env.reset_sim(key, jnp.uint32(0), params))
    return env, jax.eval_shape(reset, keys), params


@pytest.fixture(scope="module")
def program(ants):
    """Their packed frames."""
    env, states, params = ants
    draw = jax.vmap(env.draw, in_axes=(0, None))
    return jax.jit(draw).lower(states, params).compile()


def test_no_plane_of_pixels_is_kept_for_a_geom(program):
    memory = program.memory_analysis()
    assert memory.output_size_in_bytes >= 4 * PIXELS
    # Beside the words only poses and the like.
    assert memory.temp_size_in_bytes <= 0.25 * memory.output_size_in_bytes


def test_a_pixel_costs_what_it_should(ants):
    # Some 25 operations for each of 18 geoms, and about as many again for shading.
    env, states, params = ants
    # As the program is written: XLA counts the body of a loop once, and here is no loop.
    cost = jax.jit(jax.vmap(env.draw, in_axes=(0, None))).lower(states, params).cost_analysis()
    assert 300 < cost["flops"] / PIXELS < 1000


def test_bytes_are_few(program):
    # Words are written once, four bytes a pixel; XLA also counts the branch that is never taken.
    assert program.cost_analysis()["bytes accessed"] / PIXELS < 10


def test_pixels_are_computed_in_one_fusion(program):
    # A sphere takes one root and a capsule two; were the fusion split or repeated, there were more.
    # Each runs along all pixels at once, of which less than one vector is left over; the 84 of a
    # row leave four, which cost as much as four vectors.
    roots = len(re.findall(rf"f32\[{NUM_ENVS},{SIZE * SIZE}\]\S* sqrt\(", program.as_text()))
    assert roots == 5 + 2 * 12


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="needs two cores")
def test_pixels_are_spread_over_the_cores(program):
    shape = rf"u32\[{NUM_ENVS},{SIZE * SIZE}\]"
    lines = [
        line for line in program.as_text().splitlines() if re.search(rf"= {shape}.* fusion", line)
    ]
    # The other one fills the branch that is never taken.
    drawing = [line for line in lines if "broadcast" not in line.split("=")[0]]
    assert len(drawing) == 1, drawing
    assert 'outer_dimension_partitions":["' in drawing[0]


@pytest.mark.parametrize("shadows", [pytest.param(False, marks=pytest.mark.slow), True])
def test_every_shape_and_light_is_in_the_one_fusion(shadows):
    """A root or a quotient that two operations read would be kept as an image of its own."""
    scene = random_strip(0)
    lamps = (LAMP, LAMP.replace(exponent=3))
    scene = scene.replace(look=scene.look.replace(lamps=lamps, shadows=shadows))
    scene = jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * 16), scene)

    def packed(scene):
        frame = render(scene, SIZE, SIZE)
        r, g, b = (jnp.uint32(255 * plane) for plane in (frame.r, frame.g, frame.b))
        return r | g << 8 | b << 16

    memory = jax.jit(jax.vmap(packed)).lower(scene).compile().memory_analysis()
    assert memory.temp_size_in_bytes <= 0.25 * memory.output_size_in_bytes
