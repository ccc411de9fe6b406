"""A trained policy from its file, without the code that trained it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp

from pixelbrax_jax.extras import install_extra


def load_policy(path: str | Path) -> Callable[[jax.Array], jax.Array]:
    """Return the policy of a file: (B, H, W, 3 K) uint8 pixels -> (B, A) float32 actions.

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
