"""What a checkpoint is on disk, and how parts of it are read."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

FORMAT = 4
"""Number of the format; raised when what is stored changes its meaning."""

_NETWORKS_ALONE = (2, 3)
"""Former formats whose networks can be read: their runs can be evaluated, and not gone on with."""

Tree = TypeVar("Tree")


class CheckpointError(RuntimeError):
    """A checkpoint cannot be written or read; the message says why and what to do."""


class DiskFullError(CheckpointError):
    """There is no room for a checkpoint; raised in all processes alike, before any writes."""


def latest_steps(folder: str | Path) -> int | None:
    """Return the control steps of the latest checkpoint in a folder; None if there is none."""
    return max(_all_steps(Path(folder)), default=None)


def best_steps(folder: str | Path) -> int | None:
    """Return the steps of the checkpoint with the highest score; None if none has a score."""
    scores = {steps: read_about(folder, steps)["score"] for steps in _all_steps(Path(folder))}
    scores = {steps: score for steps, score in scores.items() if score is not None}
    return max(scores, key=lambda steps: (scores[steps], steps), default=None)


def read_about(folder: str | Path, steps: int | None = None) -> dict[str, Any]:
    """Return what is stored beside a checkpoint's arrays: algorithm, config, steps, score.

    Args:
        folder: of the checkpoints.
        steps: of which one; None takes the latest.

    Raises:
        CheckpointError: there is none, or it is of another format.
    """
    folder = Path(folder)
    known = _all_steps(folder)
    if not known:
        why = "" if folder.exists() else ", for there is no such folder"
        raise CheckpointError(f"there is no checkpoint in {folder}{why}.")
    path = folder / str(known[-1] if steps is None else steps) / "about" / "metadata"
    if not path.exists():
        raise CheckpointError(
            f"there is no checkpoint in {path.parents[1]}; there are those of "
            f"{', '.join(map(str, known))} steps."
        )
    about: dict[str, Any] = json.loads(path.read_text("utf-8"))
    if about.get("format") not in (*_NETWORKS_ALONE, FORMAT):
        raise CheckpointError(
            f"{path.parents[1]} has format {about.get('format')!r}, this version reads {FORMAT}."
        )
    return about


def read_networks(folder: str | Path, template: Tree, steps: int | None = None) -> Tree:
    """Return parameters alone, of a checkpoint of any settings with equal networks.

    Args:
        folder: of the checkpoints.
        template: networks of the same shapes, or their ``jax.eval_shape``.
        steps: as for `read_about`.

    Raises:
        CheckpointError: there is none, or its networks have other shapes.
    """
    about = read_about(folder, steps)
    path = Path(folder).absolute() / str(about["steps"]) / "state"
    wanted, stored = leaves_of({"networks": template}), shapes_of(path)
    for name, leaf in wanted.items():
        if stored.get(name) != leaf.shape:
            found = stored.get(name, "missing")
            raise CheckpointError(f"{path.parent}: {name} is {found}, not {leaf.shape}.")
    as_numpy = {name: ocp.RestoreArgs(restore_type=np.ndarray) for name in wanted}
    with without_warnings():
        restored = ocp.Checkpointer(ocp.PyTreeCheckpointHandler()).restore(
            path, args=ocp.args.PyTreeRestore(wanted, restore_args=as_numpy, partial_restore=True)
        )
    leaves = {name: jax.device_put(restored[name]) for name in wanted}
    return tree_of({"networks": template}, leaves)["networks"]


def shapes_of(path: Path) -> dict[str, tuple[int, ...]]:
    """Return the shapes of stored arrays, by their place."""
    with without_warnings():
        found = ocp.Checkpointer(ocp.PyTreeCheckpointHandler()).metadata(path)
    return {name: tuple(leaf.shape) for name, leaf in found.item_metadata.tree.items()}


def _all_steps(folder: Path) -> list[int]:
    # Without the file, a folder is one that is being deleted.
    found = (path for path in folder.glob("*") if path.name.isdigit())
    return sorted(int(path.name) for path in found if (path / "about" / "metadata").exists())


def leaves_of(tree: Any) -> dict[str, Any]:
    """Return leaves by their place, keys as numbers; without empty arrays, which tell nothing."""
    leaves = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            if isinstance(leaf, jax.ShapeDtypeStruct):
                data = jax.eval_shape(jax.random.key_data, leaf)
                leaf = jax.ShapeDtypeStruct(data.shape, data.dtype, sharding=leaf.sharding)
            else:
                leaf = jax.random.key_data(leaf)
        if leaf.size:
            leaves[_place(path)] = leaf
    return leaves


def tree_of(template: Tree, leaves: dict[str, Any]) -> Tree:
    """Return the tree that `leaves_of` took apart."""

    def leaf(path: Any, like: Any) -> Any:
        if not like.size:
            # Made by a program, as those of other processes' devices must be.
            empty = jax.jit(
                lambda: jnp.zeros(like.shape, like.dtype), out_shardings=sharding_of(like)
            )
            return empty()
        value = leaves[_place(path)]
        if jnp.issubdtype(like.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(value)
        return value

    return jax.tree_util.tree_map_with_path(leaf, template)


def _place(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def sharding_of(leaf: Any) -> Any:
    """Return where a leaf is, or shall be; the first device where it does not say."""
    if getattr(leaf, "sharding", None) is not None:
        return leaf.sharding
    return jax.sharding.SingleDeviceSharding(jax.devices()[0])


@contextmanager
def without_warnings() -> Iterator[None]:
    """Silence Orbax's warnings."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)
