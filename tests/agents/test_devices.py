"""Two devices share the images of a convolution, which is a loop on a CPU."""

from __future__ import annotations

import pytest

from tests.two_devices import run_on_two_devices

SCRIPT = """
import re
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import NamedSharding, PartitionSpec as P
from pixelbrax_jax.agents.networks.convolution import convolve
from pixelbrax_jax.envs.sharded import AXIS, make_env_mesh

NUM_IMAGES = {num_images}
mesh = make_env_mesh(2)
kernel = jax.random.normal(jax.random.key(0), (3, 3, 2, 5))
images = jax.random.normal(jax.random.key(1), (NUM_IMAGES, 9, 8, 2))
spread = NamedSharding(mesh, P(AXIS if NUM_IMAGES % 2 == 0 else None))

def native(x, kernel):
    pads = ((1, 0), (0, 1))
    numbers = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(x, kernel, (2, 2), pads, dimension_numbers=numbers)

def pulled(function):
    def both(x, kernel):
        y, pull = jax.vjp(function, x, kernel)
        return y, *pull(jnp.sin(y))
    return both

arguments = jax.device_put(images, spread), jax.device_put(kernel, NamedSharding(mesh, P()))
ours = pulled(lambda x, kernel: convolve(x, kernel, 2, ((1, 0), (0, 1))))
program = jax.jit(ours, out_shardings=(spread, spread, NamedSharding(mesh, P())))
program = program.lower(*arguments).compile()
for a, b in zip(program(*arguments), jax.jit(pulled(native))(images, kernel), strict=True):
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)
# Policies are exported for batches of any size.
(size,) = jax.export.symbolic_shape("size")
shapes = jax.ShapeDtypeStruct((size, 9, 8, 2), images.dtype), kernel
exported = jax.export.export(jax.jit(lambda x, kernel: ours(x, kernel)[0]))(*shapes)
np.testing.assert_allclose(exported.call(images, kernel), native(images, kernel), atol=1e-4)
moves = re.findall(r" (all-[a-z]+|collective-permute)[-a-z]*[(]", program.as_text())
print(jax.device_count(), *moves)
"""


@pytest.mark.parametrize(
    ("num_images", "told"), [(6, ["2", "all-reduce"]), (5, ["2"])], ids=["half each", "odd"]
)
def test_two_devices_sum_the_gradients_of_their_own_images(num_images, told):
    assert run_on_two_devices(SCRIPT.format(num_images=num_images)).split() == told
