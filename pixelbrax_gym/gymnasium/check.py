"""The contract of ``gymnasium.vector.VectorEnv`` as a function that third parties can run."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

_REPLAYED_STEPS = 5
"""Steps that are taken twice to see whether they repeat."""


class VectorEnvError(AssertionError):
    """An environment breaks a rule that agents and wrappers rely on."""


class VectorEnvWarning(UserWarning):
    """A rule could not be checked, or is broken in a way that many environments share."""


def check_vector_env(env: VectorEnv, *, seed: int = 0, num_steps: int = 200) -> None:
    """Drive a vector environment with random actions, and check what others rely on.

    Checked are, in this order:

    * the four spaces, ``num_envs`` and ``metadata["autoreset_mode"]`` are there and agree;
    * observations lie in the space, rewards are (N,) finite floats, flags (N,) bools;
    * every info ``key`` has an (N,) bool mask ``_key``, and values have N entries;
    * the same seed gives the same episodes;
    * what was returned is not overwritten by a later call;
    * ended episodes are followed by new ones as the declared autoreset mode says;
    * ``render()`` returns a tuple of N images;
    * with autoreset disabled, ``reset_mask`` resets the masked environments and
      neither shows nor changes anything in the others;
    * ``close()`` may be called twice.

    Arrays may be NumPy's, torch's on the CPU, or JAX's; actions are NumPy arrays.

    Two things are warnings, not errors: a caller's ``options`` that is changed, since
    Gymnasium 1.4's own ``SyncVectorEnv`` and ``AsyncVectorEnv`` remove ``reset_mask`` from it; and
    a rule that could not be checked, e.g. since no episode ended.

    Args:
        env: the environment, in any autoreset mode; closed in the end.
        seed: of the environment and the actions.
        num_steps: calls of ``step`` in which an episode should end.

    Raises:
        VectorEnvError: naming the rule that is broken.
    """
    _Check(env, seed).run(num_steps)


class _Check:
    def __init__(self, env: VectorEnv, seed: int) -> None:
        self.env, self.seed = env, seed
        # Whether each kind of reset has ever shown something else than the state before it.
        self.changed: dict[str, bool] = {}

    def run(self, num_steps: int) -> None:
        self.check_attributes()
        self.check_determinism()
        self.check_rollout(num_steps)
        self.check_render()
        if self.mode is AutoresetMode.DISABLED:
            self.check_reset_mask()
        for rule, changed in self.changed.items():
            _require(changed, rule)
        self.check_close()

    def check_attributes(self) -> None:
        env = self.env
        _require(isinstance(env, VectorEnv), "the environment must be a gymnasium VectorEnv")
        num_envs: Any = getattr(env, "num_envs", None)
        _require(
            isinstance(num_envs, (int, np.integer)) and bool(num_envs >= 1),
            f"num_envs must be a positive integer, is {num_envs!r}",
        )
        self.num_envs = int(num_envs)
        for kind in ("observation", "action"):
            single: Any = getattr(env, f"single_{kind}_space", None)
            batched: Any = getattr(env, f"{kind}_space", None)
            for name, space in ((f"single_{kind}_space", single), (f"{kind}_space", batched)):
                _require(isinstance(space, spaces.Space), f"{name} must be a Space")
            _require(
                _is_batch(single, batched, self.num_envs),
                f"{kind}_space must be single_{kind}_space, batched {self.num_envs} times: "
                f"{batched} is not that of {single}",
            )
        mode: Any = env.metadata.get("autoreset_mode")
        _require(
            isinstance(mode, AutoresetMode),
            f"metadata['autoreset_mode'] must be an AutoresetMode, is {mode!r}",
        )
        self.mode: AutoresetMode = mode
        attribute = getattr(env, "autoreset_mode", mode)
        _require(
            attribute == mode,
            f"the attribute autoreset_mode ({attribute}) must agree with the metadata ({mode})",
        )

    def check_determinism(self) -> None:
        first, again = self.replay(self.seed), self.replay(self.seed)
        _require(_equal(first, again), "the same seed and actions must give the same results")
        if _equal(first[0], self.replay(self.seed + self.num_envs)[0]):
            _warn("two different seeds give the same first observation")

    def replay(self, seed: int, reset_mask: np.ndarray | None = None) -> list[Any]:
        """Copy what a short run returns; with a mask, reset some after its first step."""
        self.env.action_space.seed(self.seed)
        obs, infos = self.env.reset(seed=seed)
        self.check_obs(obs, "reset")
        self.check_infos(infos, "reset")
        results = [_host_copy(obs)]
        for index in range(_REPLAYED_STEPS):
            returned = self.env.step(self.env.action_space.sample())
            ended = self.check_step(returned)
            results.append(_host_copy(returned[:4]))
            if ended.any():
                break
            if index == 0 and reset_mask is not None:
                self.reset_some(reset_mask, returned[0])
        return results

    def check_rollout(self, num_steps: int) -> None:
        self.env.action_space.seed(self.seed)
        obs, _ = self.env.reset(seed=self.seed)
        returned, ended, any_ended = [obs], np.zeros(self.num_envs, bool), False
        for _ in range(num_steps):
            kept = _host_copy(returned)
            returned_next = self.env.step(self.env.action_space.sample())
            _require(
                _equal(kept, _host_copy(returned)),
                "what a call returned must not be overwritten by a later one",
            )
            done = self.check_step(returned_next)
            if self.mode is AutoresetMode.NEXT_STEP and ended.any():
                self.check_first_step(returned_next, ended)
            if self.mode is AutoresetMode.SAME_STEP:
                self.check_final(returned_next[0], returned_next[4], done)
            if self.mode is AutoresetMode.DISABLED and done.any():
                self.reset_some(done, returned_next[0])
            any_ended |= bool(done.any())
            returned, ended = list(returned_next[:4]), done
        if not any_ended:
            _warn(f"no episode ended within {num_steps} steps: autoreset was not checked")

    def check_step(self, returned: Any) -> np.ndarray:
        _require(
            isinstance(returned, tuple) and len(returned) == 5,
            "step() must return observations, rewards, terminated, truncated and infos",
        )
        obs, reward, *flags, infos = returned
        self.check_obs(obs, "step")
        rewards = _host(reward)
        _require(
            rewards.shape == (self.num_envs,) and rewards.dtype.kind == "f",
            f"rewards must be floats of shape ({self.num_envs},), are {_describe(rewards)}",
        )
        _require(bool(np.isfinite(rewards).all()), "rewards must be finite")
        for name, flag in zip(("terminated", "truncated"), map(_host, flags), strict=True):
            _require(
                flag.shape == (self.num_envs,) and flag.dtype == np.bool_,
                f"{name} must be bools of shape ({self.num_envs},), is {_describe(flag)}",
            )
        self.check_infos(infos, "step")
        return _host(flags[0]) | _host(flags[1])

    def check_obs(self, obs: Any, where: str) -> None:
        _check_in_space(self.env.observation_space, obs, f"the observation of {where}()")

    def check_infos(self, infos: Any, where: str) -> None:
        _require(isinstance(infos, dict), f"the infos of {where}() must be a dict")
        for name, value in infos.items():
            if name.startswith("_") and name[1:] in infos:
                continue
            _require(f"_{name}" in infos, f"infos[{name!r}] must have a mask infos['_{name}']")
            mask = _host(infos[f"_{name}"])
            _require(
                mask.shape == (self.num_envs,) and mask.dtype == np.bool_,
                f"infos['_{name}'] must be bools of shape ({self.num_envs},), is {_describe(mask)}",
            )
            if name == "final_info":
                self.check_infos(value, where)
                continue
            for leaf in _leaves(value):
                _require(
                    np.shape(leaf)[:1] == (self.num_envs,),
                    f"infos[{name!r}] must have {self.num_envs} entries",
                )

    def check_first_step(self, returned: Any, ended: np.ndarray) -> None:
        _, reward, terminated, truncated, _ = returned
        rule = "in mode NEXT_STEP, the step after the end of an episode must return"
        _require(not _host(reward)[ended].any(), f"{rule} reward 0")
        _require(
            not (_host(terminated) | _host(truncated))[ended].any(), f"{rule} both flags False"
        )

    def check_final(self, obs: Any, infos: dict[str, Any], done: np.ndarray) -> None:
        for name in ("final_obs", "final_info"):
            mask = _host(infos[f"_{name}"]) if name in infos else np.zeros_like(done)
            _require(
                np.array_equal(mask, done),
                f"in mode SAME_STEP, infos must have {name!r} exactly where an episode ended",
            )
        rule = "in mode SAME_STEP, the observation at the end of an episode must be the next one's"
        for i in np.flatnonzero(done):
            final = _row(infos["final_obs"], i)
            _check_in_space(self.env.single_observation_space, final, f"infos['final_obs'][{i}]")
            differs = not _equal(_host_copy(final), _host_copy(_row(obs, i)))
            self.changed[rule] = self.changed.get(rule, False) or differs

    def reset_some(self, mask: np.ndarray, before: Any) -> None:
        """Reset where ``mask`` and checks that only that happened; ``before`` is the last obs."""
        rule = "reset(options={'reset_mask': mask}) must"
        kept, options, mask_given = _host_copy(before), {"reset_mask": mask.copy()}, mask.copy()
        given = options["reset_mask"]
        obs, infos = self.env.reset(options=options)
        if options.get("reset_mask") is not given:
            _warn("reset() changed the caller's options; wrappers then see no reset_mask")
        _require(np.array_equal(given, mask_given), f"{rule} not write to the mask")
        self.check_obs(obs, "reset")
        self.check_infos(infos, "reset")
        for old, new in zip(_leaves(kept), _leaves(_host_copy(obs)), strict=True):
            _require(
                np.array_equal(old[~mask], new[~mask]),
                f"{rule} return the observations of the other environments as they were",
            )
            reset = f"{rule} reset the masked environments"
            differs = not np.array_equal(old[mask], new[mask])
            self.changed[reset] = self.changed.get(reset, False) or differs

    def check_reset_mask(self) -> None:
        """Check that only masked rows are reset: the others go on as if nothing had happened."""
        if self.num_envs == 1:
            return
        mask = np.zeros(self.num_envs, bool)
        mask[0] = True
        undisturbed, disturbed = self.replay(self.seed), self.replay(self.seed, mask)
        for one, other in zip(undisturbed, disturbed, strict=False):
            for left, right in zip(_leaves(one), _leaves(other), strict=True):
                _require(
                    np.array_equal(left[1:], right[1:]),
                    "reset(options={'reset_mask': mask}) must leave the other environments alone",
                )

    def check_render(self) -> None:
        if self.env.render_mode is None:
            return
        images: Any = self.env.render()
        _require(
            isinstance(images, tuple) and len(images) == self.num_envs,
            f"render() must return a tuple of {self.num_envs}, returned {type(images).__name__}",
        )
        if self.env.render_mode != "rgb_array":
            return
        for image in images:
            _require(
                isinstance(image, np.ndarray)
                and image.dtype == np.uint8
                and image.ndim == 3
                and image.shape[2] == 3,
                "render() must return uint8 NumPy arrays (height, width, 3)",
            )
        fps: Any = self.env.metadata.get("render_fps")
        _require(bool(fps) and fps > 0, f"metadata['render_fps'] must be positive, is {fps!r}")

    def check_close(self) -> None:
        try:
            self.env.close()
            self.env.close()
        except Exception as error:
            raise VectorEnvError(f"close() must work twice, but raised {error!r}.") from error
        _require(bool(self.env.closed), "the attribute closed must be True after close()")


def _require(condition: bool, rule: str) -> None:
    if not condition:
        raise VectorEnvError(rule + ".")


def _warn(message: str) -> None:
    warnings.warn(message + ".", VectorEnvWarning, stacklevel=2)


def _host(array: Any) -> np.ndarray:
    return np.asarray(array)


def _leaves(value: Any) -> Iterator[Any]:
    if isinstance(value, dict):
        for name in sorted(value):
            yield from _leaves(value[name])
    elif isinstance(value, (tuple, list)):
        for part in value:
            yield from _leaves(part)
    else:
        yield value


def _host_copy(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _host_copy(part) for name, part in value.items()}
    if isinstance(value, (tuple, list)):
        return [_host_copy(part) for part in value]
    return np.array(_host(value))


def _equal(one: Any, other: Any) -> bool:
    left, right = list(_leaves(one)), list(_leaves(other))
    return len(left) == len(right) and all(map(np.array_equal, left, right))


def _row(batch: Any, index: Any) -> Any:
    if isinstance(batch, dict):
        return {name: _row(part, index) for name, part in batch.items()}
    return batch[index]


def _describe(array: np.ndarray) -> str:
    return f"{array.dtype} of shape {array.shape}"


def _is_batch(single: spaces.Space, batched: spaces.Space, num_envs: int) -> bool:
    if isinstance(single, spaces.Box):
        # Compared by parts: a batched Box of many pixel environments takes gigabytes to build.
        return (
            isinstance(batched, spaces.Box)
            and batched.shape == (num_envs, *single.shape)
            and batched.dtype == single.dtype
            and all(
                np.array_equal(low, single.low) and np.array_equal(high, single.high)
                for low, high in (
                    (batched.low[0], batched.high[0]),
                    (batched.low[-1], batched.high[-1]),
                )
            )
        )
    if isinstance(single, spaces.Dict):
        return (
            isinstance(batched, spaces.Dict)
            and set(single.spaces) == set(batched.spaces)
            and all(_is_batch(single[name], batched[name], num_envs) for name in single.spaces)
        )
    return batch_space(single, num_envs) == batched


def _check_in_space(space: spaces.Space, value: Any, what: str) -> None:
    if isinstance(space, spaces.Dict):
        _require(
            isinstance(value, dict) and set(value) == set(space.spaces),
            f"{what} must be a dict of {', '.join(space.spaces)}",
        )
        for name, part in space.spaces.items():
            _check_in_space(part, value[name], f"{what}, entry {name!r},")
        return
    if isinstance(space, spaces.Tuple):
        _require(
            isinstance(value, tuple) and len(value) == len(space.spaces),
            f"{what} must be a tuple of {len(space.spaces)}",
        )
        for index, part in enumerate(space.spaces):
            _check_in_space(part, value[index], f"{what}, entry {index},")
        return
    if isinstance(space, spaces.Box):
        array = _host(value)
        _require(
            array.shape == space.shape and array.dtype == space.dtype,
            f"{what} must be {space.dtype} of shape {space.shape}, is {_describe(array)}",
        )
        value = array
    _require(value in space, f"{what} must lie in {space}")
