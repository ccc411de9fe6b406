"""A trained policy from its file, without the code that trained it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from pixelbrax_jax.extras import install_extra
from pixelbrax_jax.validation import check_choice, suggest

FOLDER = Path(__file__).parent / "pretrained"
"""Where the policies lie that come with the package: for each a .jax and a .json."""


@dataclass(frozen=True, eq=False)
class Policy:
    """A policy: ``policy(pixels)`` gives actions.

    Attributes:
        program: what computes them.
        shape: (H, W, 3 K) of the pixels.
        env_options: of ``pixelbrax_jax.make``, the environment that a pretrained policy was trained
            in: ``make(**policy.env_options)``. None for a policy of a file.
    """

    program: Callable[[jax.Array], jax.Array]
    shape: tuple[int, ...]
    env_options: dict[str, Any] | None = None

    def __call__(self, pixels: jax.Array) -> jax.Array:
        """Map (B, H, W, 3 K) uint8 pixels to (B, A) float32 actions.

        Raises:
            ValueError: the pixels are others.
        """
        if pixels.ndim != 4 or pixels.shape[1:] != self.shape or pixels.dtype != jnp.uint8:
            raise ValueError(
                f"the policy takes (B, {', '.join(map(str, self.shape))}) uint8 pixels, got "
                f"{pixels.shape} {pixels.dtype}."
            )
        return self.program(pixels)


def list_pretrained() -> tuple[str, ...]:
    """Return the names of the policies that come with the package, sorted."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.json")))


def read_pretrained(name: str) -> dict[str, Any]:
    """Return what is known of a policy that comes with the package.

    Args:
        name: one of ``list_pretrained()``.

    Returns:
        ``algorithm``, ``config`` (all settings of its training), ``env_options``, ``command``,
        ``steps`` (control steps of its training), ``return``, ``standard_error`` and ``episodes``
        of its evaluation, and ``versions`` that it was made with.

    Raises:
        ValueError: there is none of that name.
    """
    check_choice("pretrained policy", name, list_pretrained())
    about: dict[str, Any] = json.loads((FOLDER / f"{name}.json").read_text("utf-8"))
    return about


def load_policy(path: str | Path) -> Policy:
    """Return a policy.

    Args:
        path: of the file ``policy.jax`` that a training run leaves; or the name of a policy that
            comes with the package, one of ``list_pretrained()``.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no policy, or one that the installed JAX cannot read.
        ImportError: flatbuffers, which JAX reads it with, is not installed.
    """
    name, path, about = str(path), Path(path), None
    if not path.is_file():
        if name not in (names := list_pretrained()):
            raise FileNotFoundError(
                f"{name!r} is no file, and no policy of that name comes with the package; there "
                f"are: {', '.join(names)}.{suggest(name, names)}"
            )
        path, about = FOLDER / f"{name}.jax", read_pretrained(name)
    try:
        exported = jax.export.deserialize(bytearray(path.read_bytes()))
    except ImportError as error:
        raise ImportError(
            f"a policy needs flatbuffers, which is not installed; try: {install_extra('train')}"
        ) from error
    except Exception as error:
        made = f" It was made with jax {about['versions']['jax']}." if about else ""
        raise ValueError(
            f"{path} is no exported policy that jax {version('jax')} can read: {error}.{made}"
        ) from error
    (wanted,) = exported.in_avals
    options = about["env_options"] if about else None
    return Policy(jax.jit(exported.call), tuple(wanted.shape[1:]), options)
