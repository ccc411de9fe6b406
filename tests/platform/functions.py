"""Functions of (3,) float32 that use JAX's primitives in most ways."""

from __future__ import annotations

import jax
import jax.numpy as jnp

by_platform = jax.lax.platform_dependent

TABLE = jnp.arange(12.0).reshape(4, 3)


@jax.custom_jvp
def doubled(x):
    return 2 * x


@doubled.defjvp
def _(primals, tangents):
    return doubled(*primals), 7 * tangents[0]


def late(x):
    """A loop whose second carry meets the batch in its second turn only, and a counter."""

    def turn(i, carry):
        a, b, _ = carry
        return x[i % 3] + a, a, b

    return jax.lax.fori_loop(0, 4, turn, (jnp.float32(0), jnp.float32(1), jnp.float32(2)))


def until_nine(x):
    return jax.lax.while_loop(lambda y: y[0] < 9, lambda y: y + 1.5, x)


def until_even(x):
    """A loop with constants of a row, a counter that all rows share, and rows that end apart."""
    return jax.lax.while_loop(
        lambda c: (c[0] < 7) & (c[1] < x[0] + 2),
        lambda c: (c[0] + 1, c[1] + jnp.abs(x[1]), c[2] * TABLE[0] + x),
        (jnp.int32(0), x[2], TABLE[1]),
    )


def as_often_for_all(x):
    """A loop that ends for all rows at once, with a carry that stays the same for all."""
    return jax.lax.while_loop(
        lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] + x, 2 * c[2]), (0, x, TABLE[1])
    )


def nested(x):
    def outer(carry, row):
        return jax.lax.scan(lambda c, y: (c + y * carry, c * y), carry, row)

    return jax.lax.scan(outer, x[0], jnp.stack([x, TABLE[0], 2 * x]), reverse=True)


FUNCTIONS = {
    "elementwise": lambda x: jnp.sin(x) * 2 + jnp.where(x > 0, x, TABLE[0]) ** 3,
    "a scalar chooses": lambda x: jnp.where(x[0] > 0, x, TABLE[1]),
    "clamp": lambda x: jax.lax.clamp(0.1, x, 0.5),
    "casts": lambda x: (x * 10).astype(jnp.int32) % 3,
    "broadcast": lambda x: x[:, None] + x[None] + TABLE[0][:, None],
    "reshape": lambda x: jnp.outer(x, x).reshape(-1)[::2],
    "reshape in another order": lambda x: jnp.outer(x, TABLE[1]).reshape(-1, order="F"),
    "transpose": lambda x: jnp.outer(x, TABLE[2]).T,
    "slices": lambda x: (x[1:], x[::-1], x[0:3:2], jnp.split(x, 3)),
    "unstack": lambda x: jnp.unstack(jnp.outer(x, TABLE[0]), axis=1),
    "pad": lambda x: jnp.pad(x, (1, 2), constant_values=4.0),
    "pad with a row's own": lambda x: jax.lax.pad(x, x[0], ((1, 0, 1),)),
    "concatenate": lambda x: jnp.concatenate([x, TABLE[0], jnp.zeros(1)]),
    "stack": lambda x: (jnp.stack([x, TABLE[0]]), jnp.stack([TABLE[0], x], axis=-1)),
    "tile": lambda x: jnp.tile(jnp.outer(x, x), (2, 3)),
    "take the same": lambda x: jnp.outer(x, x)[jnp.array([2, 0, 0])],
    "take one's own": lambda x: TABLE[jnp.argmax(x)],
    "dynamic slice": lambda x: jax.lax.dynamic_slice(x, (jnp.int32(1),), (2,)),
    "dynamic slice before the start": lambda x: jax.lax.dynamic_slice(x, (jnp.int32(-5),), (1,)),
    "dynamic slices in a loop": lambda x: jax.lax.map(lambda i: x[i], jnp.arange(-5, 5)),
    "dynamic slice of a scalar": lambda x: jax.lax.dynamic_slice(x[0], (), ()),
    "dynamic slice of one's own": lambda x: jax.lax.dynamic_slice(x, (jnp.argmax(x),), (2,)),
    "take beyond the end": lambda x: (
        jnp.take(x, jnp.array([1, 7]), mode="clip"),
        x.at[jnp.array([1, 7])].get(mode="fill", fill_value=3),
    ),
    "add at the same": lambda x: jax.ops.segment_sum(jnp.outer(x, x), jnp.array([1, 0, 1]), 4),
    "add at the same, to all the same": lambda x: TABLE.at[jnp.array([1, 3])].add(x),
    "add at one's own": lambda x: TABLE.at[jnp.argmax(x)].add(x),
    "set": lambda x: (x.at[1].set(5.0), TABLE.at[2].set(x), TABLE.at[jnp.array([1, 1])].max(x)),
    "reductions": lambda x: (x.sum(), x.max(), jnp.argmin(x), jnp.cumsum(x), jnp.all(x > 0)),
    "matrix and vector": lambda x: jnp.outer(x, x) @ x,
    "matrix and the same": lambda x: TABLE @ x,
    "the same and matrix": lambda x: x @ TABLE.T,
    "batches of matrices": lambda x: jax.vmap(jnp.dot)(jnp.outer(x, x), TABLE[:3]),
    "many axes": lambda x: jnp.einsum("ijk,kj->i", TABLE[:, :, None] * x, jnp.outer(x, x)),
    "nothing to sum": lambda x: jnp.einsum("i,j->ij", x, x),
    "integers": lambda x: x.astype(jnp.int32) @ jnp.arange(3),
    "booleans": lambda x: jnp.dot(x > 0, TABLE[0] > 0),
    "short integers": lambda x: jnp.dot(
        x.astype(jnp.int8), jnp.full(3, 100, jnp.int8), preferred_element_type=jnp.int32
    ),
    "short floats": lambda x: x.astype(jnp.bfloat16) @ x.astype(jnp.bfloat16),
    "long sums": lambda x: jnp.tile(x, 20) @ jnp.ones((60, 2)),
    "sort": jnp.sort,
    "calls": lambda x: jax.jit(lambda y: jax.jit(jnp.tanh)(y) + 1)(x),
    "own derivative": doubled,
    "late in a loop": late,
    "loops within": nested,
    "a loop that ends by itself": until_nine,
    "rows that end apart": until_even,
    "a loop that ends for all": as_often_for_all,
    "a loop in a loop that ends": lambda x: jax.lax.while_loop(
        lambda y: y.sum() < 20, lambda y: until_nine(y) + 1, x
    ),
    "a loop that ends in a loop": lambda x: jax.lax.scan(
        lambda c, y: (c + until_nine(y)[1], c), jnp.float32(0), jnp.outer(x, x)
    ),
    "branches": lambda x: jax.lax.cond(x[0] > 0, jnp.sin, jnp.cos, x),
    "branches with loops": lambda x: jax.lax.cond(x[0] > 0, late, lambda y: (y[2], x[1], 1.0), x),
    "three branches": lambda x: jax.lax.switch(
        jnp.argmax(x) * 2 - 1, [jnp.sin, lambda y: TABLE[0], jnp.outer(x, x).__matmul__], x
    ),
    "a form for CPUs": lambda x: by_platform(x[0], x, cpu=jnp.multiply, default=jnp.subtract),
    "a form for CPUs in a loop": lambda x: jax.lax.scan(
        lambda c, y: (c + 1.0, by_platform(c, cpu=jnp.sin, default=jnp.cos)), jnp.float32(0), x
    ),
    "a form for CPUs of nothing": lambda x: x + by_platform(cpu=lambda: 1.0, default=lambda: 2.0),
    "the same branch": lambda x: jax.lax.switch(jnp.int32(1), [jnp.sin, jnp.cos], x),
    "draws": lambda x: jax.random.normal(jax.random.fold_in(jax.random.key(0), x[0] > 0), 2),
    "no use of it": lambda x: (TABLE, jnp.float32(3)),
    "as it is": lambda x: x,
    "nothing": lambda x: x[:0] @ jnp.zeros((0, 2)),
}  # fmt: skip
