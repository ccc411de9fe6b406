"""A policy in one file, that acts without the code that trained it."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp

from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.train_state import Networks

PLATFORMS = ("cpu", "cuda", "tpu")


def save_policy(algorithm: Algorithm, networks: Networks, path: str | Path) -> Path:
    """Write a policy's mean action as a compiled function of JAX's export format.

    The file holds program and parameters, runs on CPU, CUDA and TPU for any number of
    observations, and needs nothing but JAX: ``jax.export.deserialize(bytes).call(pixels)``.

    Args:
        algorithm: whose ``act`` is stored.
        networks: parameters.
        path: of the file.

    Returns:
        The path.
    """
    spec = algorithm.envs.env.obs_spec
    spec = spec["pixels"] if isinstance(spec, dict) else spec
    acting = {name: networks[name] for name in algorithm.acting}
    (batch,) = jax.export.symbolic_shape("batch")
    exported = jax.export.export(
        jax.jit(lambda pixels: algorithm.act(acting, pixels)), platforms=PLATFORMS
    )(jax.ShapeDtypeStruct((batch, *spec.shape), jnp.uint8))
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Written aside and renamed: a file of this name is always whole.
    part = path.with_name(path.name + ".part")
    try:
        part.write_bytes(exported.serialize())
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        raise
    return path
