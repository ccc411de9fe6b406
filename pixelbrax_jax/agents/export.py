"""A policy in one file, that acts without the code that trained it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from pixelbrax_jax.extras import install_extra

if TYPE_CHECKING:  # Who only loads a policy needs none of the training's code.
    from pixelbrax_jax.agents.algorithm import Algorithm
    from pixelbrax_jax.agents.optimizer import Networks

PLATFORMS = ("cpu", "cuda", "tpu")


def save_policy(algorithm: Algorithm, networks: Networks, path: str | Path) -> Path:
    """Writes a policy's mean action as a compiled function of JAX's export format.

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
    actor = {"actor": networks["actor"]}
    (batch,) = jax.export.symbolic_shape("batch")
    exported = jax.export.export(
        jax.jit(lambda pixels: algorithm.act(actor, pixels)), platforms=PLATFORMS
    )(jax.ShapeDtypeStruct((batch, *spec.shape), jnp.uint8))
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Written aside and renamed: a file of this name is always whole.
    part = path.with_name(path.name + ".part")
    part.write_bytes(exported.serialize())
    part.replace(path)
    return path


def load_policy(path: str | Path) -> Callable[[jax.Array], jax.Array]:
    """The policy of a file: (B, H, W, 3 K) uint8 pixels -> (B, A) float32 actions.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no policy.
        ImportError: flatbuffers, which JAX reads it with, is not installed.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no policy at {path}.")
    try:
        exported = jax.export.deserialize(bytearray(path.read_bytes()))
    except ImportError as error:
        raise ImportError(
            f"a policy needs flatbuffers, which is not installed; try: {install_extra('train')}"
        ) from error
    except Exception as error:
        raise ValueError(f"{path} is no exported policy: {error}") from error
    program = jax.jit(exported.call)
    (wanted,) = exported.in_avals
    shape = wanted.shape[1:]

    def act(pixels: jax.Array) -> jax.Array:
        if pixels.ndim != 4 or pixels.shape[1:] != shape or pixels.dtype != jnp.uint8:
            raise ValueError(
                f"the policy takes (B, {', '.join(map(str, shape))}) uint8 pixels, got "
                f"{pixels.shape} {pixels.dtype}."
            )
        action: jax.Array = program(pixels)
        return action

    return act
