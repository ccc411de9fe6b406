"""States come out of their packed form as they went in, to the bit."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_gym.programs import pack, unpack
from pixelbrax_jax.types import EnvState, PhysicsState, SimState


def state_of(num_envs):
    """A state with numbers of every width, odd bits, empty arrays and keys of two kinds."""
    rng = np.random.default_rng(num_envs)

    def bits(dtype, *shape):
        raw = rng.integers(0, 256, (num_envs, *shape, np.dtype(dtype).itemsize), np.uint8)
        return jnp.asarray(raw.view(dtype)[..., 0] if raw.size else raw.astype(dtype)[..., 0])

    engine = {
        "bfloat16": bits(jnp.bfloat16, 5),
        "bool": jnp.asarray(rng.integers(0, 2, (num_envs, 3)).astype(bool)),
        "empty": jnp.zeros((num_envs, 0, 3)),
        "float32": bits(np.float32, 2, 7),
        "int8": bits(np.int8),
        "key": jax.vmap(lambda s: jax.random.key(s, impl="rbg"))(jnp.arange(num_envs)),
        "uint16": bits(np.uint16, 1),
    }
    scalars = {name: bits(np.int32) for name in ("step_count", "time_limit_offset")}
    flags = jnp.arange(num_envs) % 2 == 0
    physics = PhysicsState(
        engine=engine,
        xpos=bits(np.float32, 2, 3),
        xquat=bits(np.float32, 2, 4),
        obs=bits(np.float32, 4),
        reward=bits(np.float32),
        terminated=flags,
        non_finite=~flags,
    )
    sim = SimState(
        physics=physics,
        episode=bits(np.uint32),
        episode_return=bits(np.float32),
        done=flags,
        distractor_state=(),
        **scalars,
    )
    keys = jax.vmap(jax.random.key)(jnp.arange(num_envs))
    return EnvState(sim=sim, frames=bits(np.uint8, 2, 2, 3), key=keys)


@pytest.mark.parametrize(("num_envs", "num_arrays"), [(1, 1), (32, 1), (33, 19)])
def test_bits_survive(num_envs, num_arrays):
    state = state_of(num_envs)
    packed = jax.jit(pack)(state)
    assert len(packed.rest) == num_arrays
    again = jax.jit(lambda packed: unpack(packed, jax.eval_shape(lambda: state)))(packed)
    for path, leaf in jax.tree_util.tree_leaves_with_path(again):
        wanted = dict(jax.tree_util.tree_leaves_with_path(state))[path]
        assert leaf.dtype == wanted.dtype
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf, wanted = jax.random.key_data(leaf), jax.random.key_data(wanted)
        assert np.asarray(leaf).tobytes() == np.asarray(wanted).tobytes(), path
