"""The format of a checkpoint, and reading parts of it."""

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
"""Number of the format, increased when the meaning of stored data changes."""

_NETWORKS_ALONE = (2, 3)
"""Former formats with readable networks; such runs can be evaluated but not continued."""

Tree = TypeVar("Tree")


class CheckpointError(RuntimeError):
    """A checkpoint cannot be written or read."""


class DiskFullError(CheckpointError):
    """The disk is too full for a checkpoint; all processes raise it before writing."""


def latest_steps(folder: str | Path) -> int | None:
    """Return the control steps of the latest checkpoint in a folder, or None."""
    return max(_all_steps(Path(folder)), default=None)


def best_steps(folder: str | Path) -> int | None:
    """Return the control steps of the checkpoint with the highest score, or None."""
    scores = {steps: read_about(folder, steps)["score"] for steps in _all_steps(Path(folder))}
    scores = {steps: score for steps, score in scores.items() if score is not None}
    return max(scores, key=lambda steps: (scores[steps], steps), default=None)


def read_about(folder: str | Path, steps: int | None = None) -> dict[str, Any]:
    """Read a checkpoint's algorithm, config, steps and score; ``steps=None`` means the latest.

    Raises:
        CheckpointError: there is no such checkpoint, or it has another format.
    """
    folder = Path(folder)
    known = _all_steps(folder)
    if not known:
        why = "" if folder.exists() else ", which does not exist"
        raise CheckpointError(f"there is no checkpoint in {folder}{why}.")
    path = folder / str(known[-1] if steps is None else steps) / "about" / "metadata"
    if not path.exists():
        raise CheckpointError(
            f"there is no checkpoint in {path.parents[1]}; existing checkpoints have "
            f"{', '.join(map(str, known))} steps."
        )
    about: dict[str, Any] = json.loads(path.read_text("utf-8"))
    if about.get("format") not in (*_NETWORKS_ALONE, FORMAT):
        raise CheckpointError(
            f"{path.parents[1]} has format {about.get('format')!r}, this version reads {FORMAT}."
        )
    return about


def read_networks(folder: str | Path, template: Tree, steps: int | None = None) -> Tree:
    """Read only the parameters; ``template`` has the same shapes, or is their ``jax.eval_shape``.

    Raises:
        CheckpointError: there is no such checkpoint, or its networks have other shapes.
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
    """Return the shapes of stored arrays by path."""
    with without_warnings():
        found = ocp.Checkpointer(ocp.PyTreeCheckpointHandler()).metadata(path)
    return {name: tuple(leaf.shape) for name, leaf in found.item_metadata.tree.items()}


def _all_steps(folder: Path) -> list[int]:
    # A folder without the file is being deleted.
    found = (path for path in folder.glob("*") if path.name.isdigit())
    return sorted(int(path.name) for path in found if (path / "about" / "metadata").exists())


def leaves_of(tree: Any) -> dict[str, Any]:
    """Return the leaves by path, without empty arrays, and with PRNG keys as numbers."""
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
    """Rebuild a tree from the leaves of `leaves_of`."""

    def leaf(path: Any, like: Any) -> Any:
        if not like.size:
            # A program makes the array, because its devices may belong to other processes.
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
    """Return the sharding of a leaf; the default is the first device."""
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
