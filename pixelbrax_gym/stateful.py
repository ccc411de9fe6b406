"""Provide the stateful environment on which every adapter is built."""

from __future__ import annotations

import inspect
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from gymnasium import error

from pixelbrax_gym.interop.actions import as_actions, name_rows
from pixelbrax_gym.interop.fork import check_not_forked, is_forked
from pixelbrax_gym.programs import Packed, Stepped, programs_of
from pixelbrax_gym.resets import SEEDS, seeds_of
from pixelbrax_jax import EnvConfig, PixelEnv, VectorPixelEnv, make
from pixelbrax_jax.config import env_config
from pixelbrax_jax.flags import is_guarded
from pixelbrax_jax.memory import check_fits
from pixelbrax_jax.types import EnvParams, EnvState
from pixelbrax_jax.validation import check_positive_int

Keep = Callable[[Stepped], Any]
"""Maps a program's result to the value that an adapter stores with the state."""

# Compiled, so that the host sends nothing.
_new_frames = jax.jit(jnp.zeros, static_argnums=(0, 1))

_LONGEST = 2**31 - 1
"""Control steps of the longest episode."""

_made: deque[tuple[EnvConfig, PixelEnv, EnvParams]] = deque(maxlen=64)
"""The latest environments, which forks of this process can use without JAX."""


class _Snapshot(struct.PyTreeNode):
    """Data stored between two calls; it is replaced only as a whole."""

    packed: Packed
    ended: Any  # () or (N,) bool, whether episodes have ended
    spare: Any = None  # frames that are not read again
    # Whether a copy or the caller may read `packed`.
    shared: bool = struct.field(default=False, pytree_node=False)
    extra: Any = None  # data of the adapter


class StatefulEnv:
    """``num_envs`` pixel environments and their current states.

    An exception during a call, such as a ``KeyboardInterrupt``, leaves the states before or after
    the call. Copies and pickles continue as the original does.

    ``reset`` and ``step`` return the ``outputs`` of ``programs.Stepped``, without the leading axis
    if ``single``. An environment seeded with s uses only ``jax.random.key(s)``, whatever its index
    and ``num_envs``. ``episode_length`` is the time limit in control steps, and ``is_limited``
    tells whether the caller gave it.
    """

    def __init__(
        self,
        adapter: type,
        task: str,
        options: Mapping[str, Any],
        *,
        num_envs: int = 1,
        autoreset_mode: str = "disabled",
        single: bool = False,
        max_episode_steps: int | None = None,
        render_size: tuple[Any, Any],
    ) -> None:
        """Build the environment without compiling it.

        Errors about unknown ``options`` also list the arguments of ``adapter``. The limit
        ``max_episode_steps`` counts calls of ``step`` (None or -1: no limit), and
        ``options["episode_length"]`` counts control steps. The shorter of the two holds.
        """
        # Without `self` and `task` at the start and `options` at the end.
        own = list(inspect.signature(vars(adapter)["__init__"]).parameters)[2:-1]
        config = env_config(task, options, own)
        self.is_limited = "episode_length" in options
        if max_episode_steps not in (None, -1):
            calls = check_positive_int("max_episode_steps", max_episode_steps)
            limit = min(calls * config.action_repeat, _LONGEST)
            # The shorter one, as with Gymnasium's own TimeLimit around an environment.
            limit = min(limit, config.episode_length) if self.is_limited else limit
            config = env_config(config, {"episode_length": limit})
            self.is_limited = True
        self.env, self.params = _make(config)
        vector = VectorPixelEnv(self.env, num_envs, autoreset_mode)
        self.num_envs, self.single = vector.num_envs, single
        self.episode_length = int(self.params.episode_length)
        height = check_positive_int("render_height", render_size[0])
        width = check_positive_int("render_width", render_size[1])
        check_fits(f"render_height={height}, render_width={width}", 3 * height * width)
        self._render_size = height, width
        self._programs = programs_of(vector, single)
        self._must_reset = autoreset_mode == "disabled"
        self._snapshot: _Snapshot | None = None
        self._device: jax.Device | None = None
        self._closed = False

    @property
    def fps(self) -> int:
        """Frames per simulated second, at least 1."""
        return max(1, round(1.0 / self.env.dt))

    def reset(
        self,
        seed: int | Sequence[int | None] | None,
        rng: np.random.Generator | None = None,
        mask: np.ndarray | None = None,
        state: Any = None,
        time_limit_offsets: np.ndarray | None = None,
        keep: Keep | None = None,
    ) -> dict[str, Any]:
        """Reset environments where ``mask``, (N,) bool, or all; ``state`` as in ``set_state``.

        Environments with a seed, ``seed + i`` or entry i of a sequence, start their episode 0. The
        others start their next episode, or sample a seed from ``rng`` at the first reset.
        ``time_limit_offsets``, (N,) int32 in [0, limit), shorten the time limits. Outputs have
        reward 0; environments that are not reset repeat their observation and flags.
        """
        self._check_usable()
        if state is not None:
            return self.set_state(state, mask)
        seeds = seeds_of(seed, self.num_envs)
        where = np.ones(self.num_envs, bool) if mask is None else mask
        if self._snapshot is None:
            if not where.all():
                raise error.ResetNeeded("the first reset must be of all environments.")
            rng = np.random.default_rng() if rng is None else rng
            first = int(rng.integers(SEEDS - self.num_envs + 1))
            seeds = [first + i if s is None else s for i, s in enumerate(seeds)]
        given = np.array([s is not None for s in seeds]) & where
        numbers = np.array([s or 0 for s in seeds], np.uint32)
        if given.all():
            stepped = self._programs.reset(numbers, self.params, time_limit_offsets)
            return self._replace(stepped, keep)
        before = self._latest
        parts = [(where & ~given, None), (given, numbers)]
        # Two calls if some environments are seeded and others are not.
        for part, new_seeds in [part for part in parts if part[0].any()] or parts[:1]:
            spare = self._spare(before)
            stepped = self._programs.reset_where(
                before.packed, part, where, self.params, new_seeds, time_limit_offsets, spare
            )
            before = _Snapshot(stepped.packed, stepped.ended)
        return self._replace(stepped, keep)

    def step(
        self, action: Any, mask: np.ndarray | None = None, keep: Keep | None = None
    ) -> dict[str, Any]:
        """Step environments where ``mask``, (N,) bool, or all, by (N, A) or (A,) actions.

        ``keep`` computes ``extra`` from the program's result. Environments that are not stepped
        repeat their observation with ``done`` False; their other outputs are undefined.
        """
        self._check_ready("step")
        if self._must_reset:
            self._check_not_ended()
        shape = (self.env.action_size,)
        action = as_actions(action, shape if self.single else (self.num_envs, *shape), self.device)
        packed, spare = self._latest.packed, self._spare(self._latest)
        return self._replace(self._programs.step(packed, action, self.params, spare, mask), keep)

    @property
    def extra(self) -> Any:
        """Result of ``keep`` in the last call; None without it."""
        return None if self._snapshot is None else self._snapshot.extra

    def replace_extra(self, extra: Any) -> None:
        """Replace ``extra`` only."""
        self._snapshot = self._latest.replace(extra=extra)

    def get_state(self) -> EnvState:
        """Return the current states; ``set_state`` continues from them bit for bit."""
        self._check_ready("get_state")
        self._snapshot = self._latest.replace(shared=True)
        return self._programs.state(self._latest.packed, self.params)

    def set_state(self, state: Any, mask: np.ndarray | None = None) -> dict[str, Any]:
        """Continue from states where ``mask``, (N,) bool, or all; return outputs as ``reset``."""
        self._check_usable()
        self._programs.check_state(state, self.params)
        if mask is None:
            return self._replace(self._programs.start(state, self.params, None, None))
        if self._snapshot is None:
            raise error.ResetNeeded("the first reset must be of all environments.")
        packed = self._snapshot.packed
        return self._replace(self._programs.start(state, self.params, packed, mask))

    def set_time_limit(self, control_steps: int) -> None:
        """Set the time limit of current and later episodes, at least 1, at most the task's own."""
        control_steps = min(filter(None, (control_steps, self.env.physics.time_limit, _LONGEST)))
        if control_steps == self.episode_length:
            return
        limit: Any = np.int32(control_steps)
        if self._device is not None:
            limit = jax.device_put(limit, self._device)
        self.params = self.params.replace(episode_length=limit)
        self.episode_length = control_steps

    @property
    def max_episode_steps(self) -> int:
        """Time limit in calls of ``step``; the last call may take fewer control steps."""
        return -(-self.episode_length // self.env.action_repeat)

    def render(self) -> jax.Array:
        """Render (N, render_height, render_width, 3) uint8 images, row 0 at the top."""
        self._check_ready("render")
        height, width = self._render_size
        what = f"images of num_envs={self.num_envs}, height={height}, width={width}"
        check_fits(what, 3 * self.num_envs * height * width)
        return self._programs.images(self._latest.packed, self.params, height, width)

    def forget(self) -> None:
        """Release the states; ``reset`` makes new ones."""
        self._snapshot = None

    def close(self) -> None:
        """Release the states; all later calls but ``close`` raise an error."""
        self.forget()
        self._closed = True

    @property
    def device(self) -> jax.Device:
        """Device of the outputs, known after the first reset."""
        if self._device is None:
            raise error.ResetNeeded("call reset() first.")
        return self._device

    def __deepcopy__(self, memo: dict[int, Any]) -> StatefulEnv:
        """Share arrays that neither the copy nor the original writes to."""
        copied = memo[id(self)] = object.__new__(type(self))
        if self._snapshot is not None:
            self._snapshot = self._snapshot.replace(shared=True, spare=None)
        copied.__dict__.update(self.__dict__)
        if self._snapshot is not None:
            # The receiver may write to it.
            extra = jax.tree.map(lambda x: x.copy(), self._snapshot.extra)
            copied._snapshot = self._snapshot.replace(extra=extra)
        return copied

    def __getstate__(self) -> dict[str, Any]:
        """Pickle arrays in host memory, without a device."""
        snapshot = self._snapshot
        if snapshot is not None:
            snapshot = snapshot.replace(spare=None, shared=False)
        arrays = jax.device_get({"_snapshot": snapshot, "params": self.params})
        return self.__dict__ | arrays | {"_device": None}

    def _check_usable(self) -> None:
        check_not_forked()
        if self._closed:
            raise error.ClosedEnvironmentError("the environment is closed; make a new one.")
        self._place()

    @property
    def _latest(self) -> _Snapshot:
        assert self._snapshot is not None
        return self._snapshot

    def _replace(self, stepped: Stepped, keep: Keep | None = None) -> dict[str, Any]:
        """Replace the states by those of a program's result, and return the outputs."""
        before, outputs = self._snapshot, stepped.outputs
        spare = None if before is None or before.shared else before.packed.frames
        if is_guarded("device_to_host"):
            # `jax.transfer_guard` rejects implicit reads. JAX caches explicit reads, after which
            # `float(x)` and `np.asarray(x)` transfer nothing.
            read = {name: x for name, x in outputs.items() if name != "obs"}
            jax.device_get((stepped.ended, read))
        extra = None if keep is None else keep(stepped)
        self._snapshot = _Snapshot(stepped.packed, stepped.ended, spare, extra=extra)
        return outputs

    @staticmethod
    def _spare(snapshot: _Snapshot) -> Any:
        """Return memory for the next frames."""
        # An interrupted call may have deleted the spare frames.
        if snapshot.spare is None or any(x.is_deleted() for x in jax.tree.leaves(snapshot.spare)):
            return jax.tree.map(lambda x: _new_frames(x.shape, x.dtype), snapshot.packed.frames)
        return snapshot.spare

    def _place(self) -> None:
        """Put unpickled arrays on the default device and store that device."""
        if self._device is not None:
            return
        self._snapshot, self.params = jax.device_put((self._snapshot, self.params))
        self._device = next(iter(self.params.episode_length.devices()))

    def _check_ready(self, what: str) -> None:
        self._check_usable()
        if self._snapshot is None:
            raise error.ResetNeeded(f"call reset() before {what}().")

    def _check_not_ended(self) -> None:
        ended = np.atleast_1d(np.asarray(self._latest.ended))
        if not ended.any():
            return
        if self.single:
            raise error.ResetNeeded("the episode has ended; call reset() before the next step().")
        raise error.ResetNeeded(
            f"the episode of environment {name_rows(ended)} has ended and autoreset is disabled; "
            'call reset(options={"reset_mask": mask}) with those entries True before the next '
            "step()."
        )


def _make(config: EnvConfig) -> tuple[PixelEnv, EnvParams]:
    """Make an environment, or return a known one in a fork that cannot run JAX."""
    # The fork fails in `reset`, whose errors Gymnasium's AsyncVectorEnv reports; an error in the
    # constructor would only close a pipe.
    known = [made for made in _made if _is_equal(made[0], config)]
    if is_forked():
        if not known:
            check_not_forked()
        return known[0][1:]
    env, params = make(config)
    # The list would keep 100 MB of clips in memory.
    if params.clips is None and not known:
        _made.append((config, env, params))
    return env, params


def _is_equal(one: EnvConfig, other: EnvConfig) -> bool:
    try:
        return one == other
    except ValueError:  # Arrays of a camera or look have no truth value.
        return False
