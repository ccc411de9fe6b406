"""Load a trained policy from its file, without the training code."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

from pixelbrax_jax.extras import install_extra
from pixelbrax_jax.validation import check_choice, suggest

FOLDER = Path(__file__).parent / "pretrained"
"""Folder of the package's policies, a .jax and a .json file for each."""


@dataclass(frozen=True, eq=False)
class Policy:
    """A policy that maps pixels to actions: ``policy(pixels)``.

    ``shape`` is (H, W, 3 K), and ``dtype`` that of the pixels; depths are float32.
    ``pixelbrax_jax.make(**policy.env_options)`` makes the environment of a pretrained policy; the
    options are None for a policy from a file.
    """

    program: Callable[[jax.Array], jax.Array]
    shape: tuple[int, ...]
    env_options: dict[str, Any] | None = None
    dtype: str = "uint8"

    def __call__(self, pixels: jax.Array) -> jax.Array:
        """Map (B, H, W, 3 K) pixels to (B, A) float32; others raise a ValueError."""
        if pixels.ndim != 4 or pixels.shape[1:] != self.shape or pixels.dtype != self.dtype:
            raise ValueError(
                f"the policy takes (B, {', '.join(map(str, self.shape))}) {self.dtype} pixels, got "
                f"{pixels.shape} {pixels.dtype}."
            )
        return self.program(pixels)


def list_pretrained() -> tuple[str, ...]:
    """List the names of the package's policies, sorted."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.json")))


def read_pretrained(name: str) -> dict[str, Any]:
    """Read how a policy of ``list_pretrained()`` was trained and evaluated.

    The keys are ``algorithm``, ``config`` (training settings), ``env_options``, ``command``,
    ``steps`` (control steps of training), ``return``, ``standard_error`` and ``episodes`` of the
    evaluation, and ``versions`` of the packages.
    """
    check_choice("pretrained policy", name, list_pretrained())
    return json.loads((FOLDER / f"{name}.json").read_text("utf-8"))


def load_policy(path: str | Path) -> Policy:
    """Load a policy: the file ``policy.jax`` of a training run, or a name of ``list_pretrained()``.

    Raises:
        FileNotFoundError: there is no such file and no such name.
        ValueError: the installed JAX cannot read the file.
        ImportError: flatbuffers is not installed.
    """
    name, path, about = str(path), Path(path), None
    if not path.is_file():
        if name not in (names := list_pretrained()):
            raise FileNotFoundError(
                f"{name!r} is neither a file nor the name of a policy; pretrained policies: "
                f"{', '.join(names)}.{suggest(name, names)}"
            )
        path, about = FOLDER / f"{name}.jax", read_pretrained(name)
    try:
        exported = jax.export.deserialize(bytearray(path.read_bytes()))
    except ImportError as error:
        raise ImportError(
            f"policies need flatbuffers, which is not installed; try: {install_extra('train')}"
        ) from error
    except Exception as error:
        made = f" It was made with jax {about['versions']['jax']}." if about else ""
        raise ValueError(
            f"jax {version('jax')} cannot read {path} as an exported policy: {error}.{made}"
        ) from error
    (wanted,) = exported.in_avals
    options = about["env_options"] if about else None
    return Policy(jax.jit(exported.call), tuple(wanted.shape[1:]), options, str(wanted.dtype))
