"""Where training stands, on disk: written whole or not at all, and read back to the bit."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from pixelbrax_jax.agents.runner.devices import any_process
from pixelbrax_jax.agents.runner.settings import differences, unknown_settings, versions

FORMAT = 4
"""Number of the format; raised when what is stored changes its meaning."""

_NETWORKS_ALONE = (2, 3)
"""Former formats whose networks can be read: their runs can be evaluated, and not gone on with."""

_ROOM = 1.2
"""Free bytes on the disk that are asked for, in sizes of a checkpoint."""

Tree = TypeVar("Tree")


class CheckpointError(RuntimeError):
    """A checkpoint cannot be written or read; the message says why and what to do."""


class DiskFullError(CheckpointError):
    """There is no room for a checkpoint; raised in all processes alike, before any writes."""


class Checkpoints:
    """The checkpoints of one run.

    Each is a folder named by the number of control steps. It appears under that name only when
    it is complete, so that a run that is killed while writing leaves the one before.

    Attributes:
        folder: where they are.
    """

    def __init__(
        self,
        folder: str | Path,
        settings: dict[str, Any],
        algorithm: str,
        *,
        keep: int = 3,
        former: Mapping[str, Any] | None = None,
        clips: Sequence[str] | None = None,
    ) -> None:
        """Open the folder, which is made if need be.

        Args:
            folder: where the checkpoints are.
            settings: by name, stored with every checkpoint.
            algorithm: name of the algorithm, stored likewise.
            keep: how many of the latest are kept, besides the best one.
            former: by name, what a stored run had that lacks a setting.
            clips: digests of the clips that are played, which decide in place of their folder
                whether they are the same; None of clips that their name tells.

        Raises:
            CheckpointError: the folder cannot be written to.
        """
        self.folder = Path(folder).absolute()
        self._about: dict[str, Any] = {
            "format": FORMAT,
            "algorithm": algorithm,
            "config": settings,
            "clips": None if clips is None else list(clips),
            "versions": versions(),
        }
        self._former = dict(former or {})
        _check_writable(self.folder)
        policy = ocp.checkpoint_managers
        best = policy.BestN(
            get_metric_fn=lambda m: m["score"], n=1, keep_checkpoints_without_metrics=False
        )
        options = ocp.CheckpointManagerOptions(
            preservation_policy=policy.AnyPreservationPolicy([policy.LatestN(keep), best]),
            # Without it scores are not written, and a resumed run would drop the best.
            best_fn=lambda metrics: metrics["score"],
            cleanup_tmp_directories=True,
        )
        self._manager = ocp.CheckpointManager(self.folder, options=options)
        self._writing = False
        logging.getLogger("absl").addFilter(_not_a_traceback)

    def steps(self) -> list[int]:
        """Return control steps of all checkpoints, ascending."""
        return sorted(self._manager.all_steps())

    def save(self, state: Any, steps: int, score: float | None) -> None:
        """Begin to write a checkpoint; training may go on meanwhile.

        Args:
            state: any pytree of arrays.
            steps: control steps so far.
            score: the higher, the better; None if it is not known.

        Raises:
            DiskFullError: there is no room for it.
            CheckpointError: it cannot be written, or the one before, which was being written,
                could not be.
        """
        self.wait()
        leaves = _plain(state)
        size = sum(leaf.nbytes for leaf in leaves.values())
        try:
            free = shutil.disk_usage(self.folder).free
        except OSError as error:
            raise self._failed(error) from error
        if any_process(free < _ROOM * size):
            raise DiskFullError(
                f"a checkpoint takes {_bytes(size)}, but {self.folder} has only {_bytes(free)} "
                "free."
            )
        about = self._about | {"steps": steps, "score": score}
        arguments = ocp.args.Composite(
            state=ocp.args.StandardSave(leaves), about=ocp.args.JsonSave(about)
        )
        metrics = None if score is None else {"score": score}
        try:
            with _without_warnings():  # That there is no score is no mistake.
                self._manager.save(steps, args=arguments, metrics=metrics, force=True)
        except (OSError, ValueError) as error:
            raise self._failed(error) from error
        self._writing = True

    def is_written(self) -> bool:
        """Return whether nothing is being written any more.

        Raises:
            CheckpointError: the checkpoint that was being written could not be.
        """
        if self._writing and not self._manager.is_saving_in_progress():
            self.wait()
        return not self._writing

    def wait(self) -> None:
        """Return when everything is written.

        Raises:
            CheckpointError: it could not be.
        """
        self._writing = False
        try:
            self._manager.wait_until_finished()
        except (OSError, ValueError) as error:  # TensorStore has a ValueError for a full disk.
            raise self._failed(error) from error

    def restore(self, template: Tree) -> Tree:
        """Return the state of the latest checkpoint, equal to the bit to what was saved.

        Args:
            template: a state of the same shapes, or its ``jax.eval_shape``.

        Raises:
            CheckpointError: there is none, or it is of another configuration or format.
        """
        about = read_about(self.folder)
        self._check(about)
        wanted = _plain(template)
        self._check_arrays(about, wanted)
        targets = {
            name: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=_sharding(leaf))
            for name, leaf in wanted.items()
        }
        restored = self._manager.restore(
            about["steps"], args=ocp.args.Composite(state=ocp.args.StandardRestore(targets))
        )
        return _typed(template, restored["state"])

    def other_versions(self) -> list[str]:
        """Return packages whose versions, and devices whose kind or number, were others then."""
        old, new = read_about(self.folder)["versions"], self._about["versions"]
        return [
            f"{name} {old.get(name)} there, {new.get(name)} here"
            for name in sorted(old.keys() | new.keys())
            if old.get(name) != new.get(name)
        ]

    def close(self) -> None:
        """Wait for what is being written, and let go of the folder."""
        try:
            self.wait()
        finally:
            # `wait` has raised what it may raise of a full disk.
            with suppress(OSError, ValueError):
                self._manager.close()
            logging.getLogger("absl").removeFilter(_not_a_traceback)

    def _failed(self, error: Exception) -> CheckpointError:
        """Return what to raise for a checkpoint that cannot be written; removes what there is."""
        if jax.process_index() == 0:
            for path in self.folder.glob("*.orbax-checkpoint-tmp*"):
                shutil.rmtree(path, ignore_errors=True)
        # The manager has left out those that the new one would have replaced.
        with suppress(OSError):
            self._manager.reload()
        # TensorStore's messages end with the system's own words.
        reason = str(error).partition("\n")[0].rsplit(": ", 1)[-1]
        reason = getattr(error, "strerror", None) or reason or type(error).__name__
        return CheckpointError(f"cannot write a checkpoint to {self.folder}: {reason}.")

    def _check(self, about: dict[str, Any]) -> None:
        """Reject a checkpoint of another format, algorithm or settings."""
        own = self._about
        if about["format"] != FORMAT:
            raise CheckpointError(
                f"{self.folder} has format {about['format']!r}, of which this version reads the "
                "networks alone: evaluate or record the run, and train anew in another "
                "--output-dir."
            )
        if about["algorithm"] != own["algorithm"]:
            raise CheckpointError(
                f"{self.folder} is a run of {about['algorithm']}, not of {own['algorithm']}; give "
                "another --output-dir."
            )
        about = about | {"config": self._former | about["config"]}
        old, new = about["config"], own["config"]
        if other := differences(about, own):
            why = unknown_settings(about, new)
            if old.get("total_steps") != new.get("total_steps") and new.get("anneal"):
                why += "A step size that falls over all of total_steps leaves them fixed. "
            raise CheckpointError(
                f"the checkpoint in {self.folder} has other settings: {'; '.join(other)}. "
                f"{why}Use the same ones, or another --output-dir."
            )

    def _check_arrays(self, about: dict[str, Any], wanted: dict[str, Any]) -> None:
        """Reject a checkpoint whose arrays are others."""
        stored = _shapes(self.folder / str(about["steps"]) / "state")
        shapes = {name: tuple(leaf.shape) for name, leaf in wanted.items()}
        other = [
            f"{name}: {stored.get(name, 'none')} there, {shapes.get(name, 'none')} here"
            for name in sorted(stored.keys() | shapes.keys())
            if stored.get(name) != shapes.get(name)
        ]
        if other:
            more = f" and {len(other) - 3} more" if len(other) > 3 else ""
            others = "; ".join(self.other_versions()) or "the versions are the same"
            raise CheckpointError(
                f"the checkpoint in {self.folder} has other arrays: {'; '.join(other[:3])}{more} "
                f"({others}). Go on with what wrote it, or train anew in another --output-dir."
            )


def latest_steps(folder: str | Path) -> int | None:
    """Return the control steps of the latest checkpoint in a folder; None if there is none."""
    return max(_all_steps(Path(folder)), default=None)


def best_steps(folder: str | Path) -> int | None:
    """Return the control steps of the checkpoint with the highest score, of equal ones the later.

    None if no checkpoint has a score.
    """
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
        steps: of which checkpoint; None takes the latest.

    Raises:
        CheckpointError: there is none, or its networks have other shapes.
    """
    about = read_about(folder, steps)
    path = Path(folder).absolute() / str(about["steps"]) / "state"
    wanted, stored = _plain({"networks": template}), _shapes(path)
    for name, leaf in wanted.items():
        if stored.get(name) != leaf.shape:
            found = stored.get(name, "missing")
            raise CheckpointError(f"{path.parent}: {name} is {found}, not {leaf.shape}.")
    as_numpy = {name: ocp.RestoreArgs(restore_type=np.ndarray) for name in wanted}
    with _without_warnings():
        restored = ocp.Checkpointer(ocp.PyTreeCheckpointHandler()).restore(
            path, args=ocp.args.PyTreeRestore(wanted, restore_args=as_numpy, partial_restore=True)
        )
    leaves = {name: jax.device_put(restored[name]) for name in wanted}
    return _typed({"networks": template}, leaves)["networks"]


def _shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Return the shapes of stored arrays, by their place."""
    with _without_warnings():
        found = ocp.Checkpointer(ocp.PyTreeCheckpointHandler()).metadata(path)
    return {name: tuple(leaf.shape) for name, leaf in found.item_metadata.tree.items()}


def _all_steps(folder: Path) -> list[int]:
    # Without the file, a folder is one that is being deleted.
    found = (path for path in folder.glob("*") if path.name.isdigit())
    return sorted(int(path.name) for path in found if (path / "about" / "metadata").exists())


def _check_writable(folder: Path) -> None:
    """Reject a folder that cannot be made or written to."""
    probe = folder / ".writable"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"")
        probe.unlink(missing_ok=True)  # Other processes try the same.
    except OSError as error:
        raise CheckpointError(
            f"cannot write to {folder}: {error.strerror or error}. Give another --output-dir."
        ) from error


def _plain(tree: Any) -> dict[str, Any]:
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


def _typed(template: Tree, leaves: dict[str, Any]) -> Tree:
    """Return the tree that `_plain` took apart."""

    def leaf(path: Any, like: Any) -> Any:
        if not like.size:
            # Made by a program, as those of other processes' devices must be.
            empty = jax.jit(
                lambda: jnp.zeros(like.shape, like.dtype), out_shardings=_sharding(like)
            )
            return empty()
        value = leaves[_place(path)]
        if jnp.issubdtype(like.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(value)
        return value

    return jax.tree_util.tree_map_with_path(leaf, template)


def _place(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def _sharding(leaf: Any) -> Any:
    if getattr(leaf, "sharding", None) is not None:
        return leaf.sharding
    return jax.sharding.SingleDeviceSharding(jax.devices()[0])


def _bytes(number: float) -> str:
    """Return a number of bytes with a unit in which it shows."""
    return f"{number / 1e9:.2f} GB" if number >= 1e8 else f"{number / 1e6:.2f} MB"


def _not_a_traceback(record: logging.LogRecord) -> bool:
    """Return whether a record is no traceback of Orbax, whose errors `Checkpoints` raises."""
    return not (record.exc_info and "orbax" in record.pathname)


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Silence Orbax's warnings."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)
