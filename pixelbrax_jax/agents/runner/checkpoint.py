"""Write and read checkpoints, atomically and bit-exactly."""

from __future__ import annotations

import json
import logging
import math
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, TypeVar

import jax
import numpy as np
import orbax.checkpoint as ocp

from pixelbrax_jax.agents.runner.devices import any_process
from pixelbrax_jax.agents.runner.progress import Report, reason, silent
from pixelbrax_jax.agents.runner.settings import differences, unknown_settings, versions
from pixelbrax_jax.flags import with_keys, without_keys

FORMAT = 4
"""Number of the format, increased when the meaning of stored data changes."""

_ROOM = 1.2
"""Free space that a checkpoint requires, relative to its size."""

_RETRY_MINUTES = 1.0

Tree = TypeVar("Tree")


class CheckpointError(RuntimeError):
    """A checkpoint cannot be written or read."""


class DiskFullError(CheckpointError):
    """The disk is too full for a checkpoint; all processes raise it before writing."""


def all_steps(folder: Path) -> list[int]:
    """Return the control steps of all complete checkpoints in a folder, ascending."""
    # A folder without the file is being deleted.
    found = (path for path in folder.glob("*") if path.name.isdigit())
    return sorted(int(path.name) for path in found if (path / "about" / "metadata").exists())


def latest_steps(folder: str | Path) -> int | None:
    """Return the control steps of the latest checkpoint in a folder, or None."""
    return max(all_steps(Path(folder)), default=None)


def best_steps(folder: str | Path) -> int | None:
    """Return the control steps of the checkpoint with the highest score, or None."""
    scored = [(read_about(folder, steps)["score"], steps) for steps in all_steps(Path(folder))]
    return max((row for row in scored if row[0] is not None), default=(None, None))[1]


def read_about(folder: str | Path, steps: int | None = None) -> dict[str, Any]:
    """Read a checkpoint's algorithm, config, steps and score; ``steps=None`` means the latest."""
    folder = Path(folder)
    known = all_steps(folder)
    if not known:
        why = "" if folder.exists() else ", which does not exist"
        raise CheckpointError(f"there is no checkpoint in {folder}{why}.")
    path = folder / str(known[-1] if steps is None else steps)
    if steps is not None and steps not in known:
        raise CheckpointError(
            f"there is no checkpoint in {path}; existing checkpoints have "
            f"{', '.join(map(str, known))} steps."
        )
    about: dict[str, Any] = json.loads((path / "about" / "metadata").read_text("utf-8"))
    if about.get("format") != FORMAT:
        raise CheckpointError(
            f"{path} has format {about.get('format')!r}, this version reads {FORMAT}."
        )
    return about


def read_networks(folder: str | Path, template: Tree, steps: int | None = None) -> Tree:
    """Read only the parameters; ``template`` has their shapes, or is their ``jax.eval_shape``."""
    steps = read_about(folder, steps)["steps"]
    return _read(Path(folder), steps, {"networks": template}, whole=False)["networks"]


class Checkpoints:
    """The checkpoints of one run, in folders named by the number of control steps.

    A folder gets its name when it is complete, so a killed run leaves the previous checkpoint. A
    checkpoint that cannot be written is reported and retried; for the last one it is an error.
    """

    def __init__(
        self,
        folder: str | Path,
        about: Mapping[str, Any],
        *,
        keep: int = 3,
        former: Mapping[str, Any] | None = None,
        every: int = 0,
        minutes: float = 0.0,
        report: Report = silent,
    ) -> None:
        """Create the folder; every checkpoint stores ``about``, the result of ``describe_run``.

        ``former`` has values of settings that a stored run may lack, ``RunConfig`` the others.
        """
        self.folder = Path(folder).absolute()
        self._about = {"format": FORMAT, **about, "versions": versions()}
        self._former = dict(former or {})
        self._every, self._minutes, self._report = every, minutes, report
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            TemporaryFile(dir=self.folder).close()
        except OSError as error:
            raise CheckpointError(
                f"cannot write to {self.folder}: {reason(error)}. Use another --output-dir."
            ) from error
        policy = ocp.checkpoint_managers
        best = policy.BestN(
            get_metric_fn=lambda m: m["score"], n=1, keep_checkpoints_without_metrics=False
        )
        options = ocp.CheckpointManagerOptions(
            preservation_policy=policy.AnyPreservationPolicy([policy.LatestN(keep), best]),
            # Stores the scores, without which a resumed run would delete the best checkpoint.
            best_fn=lambda metrics: metrics["score"],
            cleanup_tmp_directories=True,
        )
        self._manager = ocp.CheckpointManager(self.folder, options=options)
        self._writing = self._failing = False
        self._last_steps = latest_steps(self.folder) or 0
        self._due = self._in_minutes(minutes)
        logging.getLogger("absl").addFilter(_not_a_traceback)

    def is_due_by_clock(self) -> bool:
        """Return whether the clock of this process demands a checkpoint."""
        return time.monotonic() >= self._due

    def is_due_after(self, steps: int) -> bool:
        """Return whether this number of control steps demands a checkpoint."""
        return bool(self._every) and steps // self._every > self._last_steps // self._every

    def save(self, state: Any, steps: int, score: float | None, *, last: bool = False) -> None:
        """Start to write a checkpoint, and wait if it is the ``last``. A high ``score`` is good.

        Raises:
            CheckpointError: the last checkpoint cannot be written, or only some processes fail.
        """
        self.look_after(wait=True)
        self._last_steps, self._due = steps, self._in_minutes(self._minutes)
        try:
            self._write(state, steps, score)
            if last:
                self._wait()
        except CheckpointError as error:
            if not last:
                self._fail(error)
                return
            latest = latest_steps(self.folder)
            kept = "no other exists" if latest is None else f"that of {latest} steps remains"
            raise CheckpointError(
                f"the last checkpoint, of {steps} steps, is lost; {kept}. {error} Free disk space "
                "or make the folder writable, then continue with --resume latest."
            ) from error

    def look_after(self, *, wait: bool = False) -> None:
        """Report the result of the current checkpoint; raises like `save`."""
        # Several processes must look at the same time, which only `wait` ensures.
        alone = self._writing and jax.process_count() == 1
        if not wait and (not alone or self._manager.is_saving_in_progress()):
            return
        try:
            self._wait()
        except CheckpointError as error:
            self._fail(error)
            return
        if self._failing and latest_steps(self.folder) == self._last_steps:
            self._failing = False
            self._report(f"the checkpoint of {self._last_steps} steps is written")

    def restore(self, template: Tree) -> Tree:
        """Restore the latest checkpoint; ``template`` is a state or its ``jax.eval_shape``."""
        about = read_about(self.folder)
        self._check(about)
        others = "; ".join(self.other_versions()) or "the versions are equal"
        advice = (
            f" ({others}). Continue with the versions that wrote it, or use another --output-dir"
        )
        return _read(self.folder, about["steps"], template, whole=True, advice=advice)

    def other_versions(self) -> list[str]:
        """Describe packages and devices that differ from those of the checkpoint."""
        old, new = read_about(self.folder)["versions"], self._about["versions"]
        return [
            f"{name} {old.get(name)} there, {new.get(name)} here"
            for name in sorted(old.keys() | new.keys())
            if old.get(name) != new.get(name)
        ]

    def close(self) -> None:
        """Finish the current checkpoint and close the folder."""
        try:
            self._wait()
        finally:
            # `_wait` has already raised the errors of a full disk.
            with suppress(OSError, ValueError):
                self._manager.close()
            logging.getLogger("absl").removeFilter(_not_a_traceback)

    def _write(self, state: Any, steps: int, score: float | None) -> None:
        leaves = {name: without_keys(leaf) for name, leaf in _leaves(state).items()}
        size = sum(leaf.nbytes for leaf in leaves.values())
        about = self._about | {"steps": steps, "score": score}
        arguments = ocp.args.Composite(
            state=ocp.args.StandardSave(leaves), about=ocp.args.JsonSave(about)
        )
        metrics = None if score is None else {"score": score}
        with self._cleaned():
            free = shutil.disk_usage(self.folder).free
            if any_process(free < _ROOM * size):
                raise DiskFullError(
                    f"a checkpoint needs {_bytes(size)}, but {self.folder} has only "
                    f"{_bytes(free)} free."
                )
            with _without_warnings():  # A checkpoint may have no score.
                self._manager.save(steps, args=arguments, metrics=metrics, force=True)
        self._writing = True

    def _wait(self) -> None:
        self._writing = False
        with self._cleaned():
            self._manager.wait_until_finished()

    def _fail(self, error: CheckpointError) -> None:
        if jax.process_count() > 1 and not isinstance(error, DiskFullError):
            raise error
        if not self._failing:
            self._report(f"{error} Training continues and will retry the checkpoint.")
        self._failing = True
        self._due = self._in_minutes(min(self._minutes, _RETRY_MINUTES))

    def _in_minutes(self, minutes: float) -> float:
        return time.monotonic() + 60 * minutes if self._minutes else math.inf

    @contextmanager
    def _cleaned(self) -> Iterator[None]:
        """Remove the incomplete checkpoint after an error."""
        try:
            yield
        except (OSError, ValueError) as error:  # TensorStore raises ValueError for a full disk.
            if jax.process_index() == 0:
                for path in self.folder.glob("*.orbax-checkpoint-tmp*"):
                    shutil.rmtree(path, ignore_errors=True)
            # The manager has already forgotten the checkpoints that the new one would replace.
            with suppress(OSError):
                self._manager.reload()
            # TensorStore's messages end with the message of the operating system.
            why = reason(error).rsplit(": ", 1)[-1]
            raise CheckpointError(f"cannot write a checkpoint to {self.folder}: {why}.") from error

    def _check(self, about: dict[str, Any]) -> None:
        own = self._about
        if about["algorithm"] != own["algorithm"]:
            raise CheckpointError(
                f"{self.folder} is a run of {about['algorithm']}, not of {own['algorithm']}; use "
                "another --output-dir."
            )
        about = about | {"config": self._former | about["config"]}
        old, new = about["config"], own["config"]
        if other := differences(about, own):
            why = unknown_settings(about, new)
            if old.get("total_steps") != new.get("total_steps") and new.get("anneal"):
                why += (
                    "With anneal, total_steps cannot change, because the step size depends on it. "
                )
            raise CheckpointError(
                f"the checkpoint in {self.folder} has other settings: {'; '.join(other)}. "
                f"{why}Use the same settings, or another --output-dir."
            )


def _read(folder: Path, steps: int, template: Tree, *, whole: bool, advice: str = "") -> Tree:
    """Read the arrays of a tree: the ``whole`` checkpoint or a part of it."""
    leaves = _leaves(template)
    wanted = {name: jax.eval_shape(without_keys, leaf) for name, leaf in leaves.items()}
    shapes = {name: leaf.shape for name, leaf in wanted.items()}
    path = folder.absolute() / str(steps) / "state"
    reader = ocp.Checkpointer(ocp.PyTreeCheckpointHandler())
    with _without_warnings():
        arrays = reader.metadata(path).item_metadata.tree
        stored = {name: tuple(leaf.shape) for name, leaf in arrays.items()}
        other = [
            f"{name}: {stored.get(name, 'none')} there, {shapes.get(name, 'none')} here"
            for name in sorted(stored.keys() | shapes.keys() if whole else shapes)
            if stored.get(name) != shapes.get(name)
        ]
        if other:
            more = f" and {len(other) - 3} more" if len(other) > 3 else ""
            found = "; ".join(other[:3]) + more
            raise CheckpointError(f"the checkpoint in {folder} has other arrays: {found}{advice}.")
        placed = {n: _restore_args(x) for n, x in leaves.items()}
        arguments = ocp.args.PyTreeRestore(wanted, restore_args=placed, partial_restore=True)
        restored = reader.restore(path, args=arguments)

    def leaf(path: Any, like: Any) -> Any:
        value = restored[_name(path)] if like.size else np.zeros(like.shape, like.dtype)
        # Without a sharding JAX chooses the device, as in a new run, so the program is the same.
        return with_keys(jax.device_put(value, like.sharding), like)

    return jax.tree_util.tree_map_with_path(leaf, template)


def _leaves(tree: Any) -> dict[str, Any]:
    """Return the leaves by path, without empty arrays."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {_name(path): leaf for path, leaf in leaves if leaf.size}


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def _restore_args(leaf: Any) -> ocp.RestoreArgs:
    if leaf.sharding:
        return ocp.ArrayRestoreArgs(sharding=leaf.sharding)
    return ocp.RestoreArgs(restore_type=np.ndarray)


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


def _bytes(number: float) -> str:
    return f"{number / 1e9:.2f} GB" if number >= 1e8 else f"{number / 1e6:.2f} MB"


def _not_a_traceback(record: logging.LogRecord) -> bool:
    """Reject tracebacks of Orbax, because `Checkpoints` raises its errors."""
    return not (record.exc_info and "orbax" in record.pathname)
