"""What a program computes is decided by what it is lowered for, not by where it is traced."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

from pixelbrax_jax._platform.lowering import by_platform, trace_once


@pytest.mark.parametrize(("platform", "form"), [("cpu", "sine"), ("cuda", "cosine")])
@pytest.mark.parametrize("batched", [False, True])
def test_a_program_has_the_form_of_its_platform(platform, form, batched):
    def function(x):
        return by_platform(x, cpu=jnp.sin, default=jnp.cos)

    function = jax.vmap(function) if batched else function
    text = jax.jit(function).trace(jnp.ones(3)).lower(lowering_platforms=(platform,)).as_text()
    assert f"stablehlo.{form}" in text
    assert ("stablehlo.sine" in text) != ("stablehlo.cosine" in text)


def test_what_forms_share_is_traced_once():
    traces = []

    @trace_once
    def shared(x):
        traces.append(None)
        return x * 2.0

    def both(x):
        return by_platform(x, cpu=shared, default=jax.vmap(shared))

    assert jax.make_jaxpr(both)(jnp.ones(3))
    # Of a row, and of all rows.
    assert len(traces) == 2
