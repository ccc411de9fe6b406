"""Check that an environment follows the contract of ``gymnasium.vector.VectorEnv``."""

from __future__ import annotations

import warnings
from typing import Any

import jax
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

_REPLAYED_STEPS = 5
"""Number of steps that are replayed to check determinism."""


class VectorEnvError(AssertionError):
    """A broken rule that agents and wrappers rely on."""


class VectorEnvWarning(UserWarning):
    """A rule that could not be checked, or that Gymnasium's own environments break too."""


def check_vector_env(env: VectorEnv, *, seed: int = 0, num_steps: int = 200) -> None:
    """Run a vector environment with a random policy and check the rules that others rely on.

    The rules, in this order:

    * the four spaces, ``num_envs`` and ``metadata["autoreset_mode"]`` exist and agree;
    * observations lie in the space, rewards are (N,) finite floats, flags (N,) bools;
    * every info ``key`` has an (N,) bool mask ``_key``, and values have N entries;
    * the same seed gives the same episodes;
    * later calls do not overwrite results;
    * episodes reset as the autoreset mode requires;
    * ``render()`` returns a tuple of N images;
    * with autoreset disabled, ``reset_mask`` resets only the masked environments;
    * ``close()`` may be called twice.

    Arrays may be NumPy's, torch's on the CPU, or JAX's; actions are NumPy arrays. The function
    only warns if a rule could not be checked, e.g. because no episode ended, or if ``reset``
    changes ``options``, because Gymnasium 1.4's ``SyncVectorEnv`` and ``AsyncVectorEnv`` do.

    Args:
        env: the environment, in any autoreset mode; it is closed at the end.
        seed: seed of the environment and the actions.
        num_steps: calls of ``step`` in which an episode should end.

    Raises:
        VectorEnvError: a rule is broken.
    """
    check = _Check(env, seed)
    check.determinism()
    check.rollout(num_steps)
    check.render()
    if check.mode is AutoresetMode.DISABLED and check.num_envs > 1:
        check.reset_of_others()
    for rule, changed in check.changed.items():
        _require(changed, rule)
    check.close()


class _Check:
    """An environment under test; the constructor checks attributes and spaces."""

    def __init__(self, env: VectorEnv, seed: int) -> None:
        _require(isinstance(env, VectorEnv), "the environment must be a gymnasium VectorEnv")
        num_envs: Any = getattr(env, "num_envs", None)
        _require(
            isinstance(num_envs, (int, np.integer)) and bool(num_envs >= 1),
            f"num_envs must be a positive integer, is {num_envs!r}",
        )
        self.env, self.seed, self.num_envs = env, seed, int(num_envs)
        # Rule -> whether a reset has ever changed an observation.
        self.changed: dict[str, bool] = {}
        for kind in ("observation", "action"):
            single: Any = getattr(env, f"single_{kind}_space", None)
            batched: Any = getattr(env, f"{kind}_space", None)
            for name, space in ((f"single_{kind}_space", single), (f"{kind}_space", batched)):
                _require(isinstance(space, spaces.Space), f"{name} must be a Space")
            _require(
                batch_space(single, self.num_envs) == batched,
                f"{kind}_space must be single_{kind}_space, batched {self.num_envs} times: "
                f"{batched} is not that of {single}",
            )
        mode: Any = env.metadata.get("autoreset_mode")
        _require(
            isinstance(mode, AutoresetMode),
            f"metadata['autoreset_mode'] must be an AutoresetMode, is {mode!r}",
        )
        self.mode: AutoresetMode = mode
        own = getattr(env, "autoreset_mode", mode)
        rule = f"the attribute autoreset_mode ({own}) must agree with the metadata ({mode})"
        _require(own == mode, rule)

    def determinism(self) -> None:
        first, again = self.replay(self.seed), self.replay(self.seed)
        _require(_equal(first, again), "the same seed and actions must give the same results")
        if _equal(first[0], self.replay(self.seed + self.num_envs)[0]):
            _warn("two different seeds give the same first observation")

    def reset_of_others(self) -> None:
        """Check that a masked reset does not affect later steps of the other environments."""
        mask = np.arange(self.num_envs) == 0
        undisturbed, disturbed = self.replay(self.seed), self.replay(self.seed, mask)
        for one, other in zip(undisturbed, disturbed, strict=False):
            _require(
                _equal(_rows(one, slice(1, None)), _rows(other, slice(1, None))),
                "reset(options={'reset_mask': mask}) must leave the other environments alone",
            )

    def replay(self, seed: int, reset_mask: np.ndarray | None = None) -> list[Any]:
        """Return copies of a short run's results; a mask resets some after the first step."""
        self.env.action_space.seed(self.seed)
        results = [_copy(self.check_reset(self.env.reset(seed=seed)))]
        for index in range(_REPLAYED_STEPS):
            returned = self.env.step(self.env.action_space.sample())
            ended = self.check_step(returned)
            results.append(_copy(returned[:4]))
            if ended.any():
                break
            if index == 0 and reset_mask is not None:
                self.reset_some(reset_mask, returned[0])
        return results

    def rollout(self, num_steps: int) -> None:
        self.env.action_space.seed(self.seed)
        latest: tuple[Any, ...] = self.env.reset(seed=self.seed)[:1]
        ended, any_ended = np.zeros(self.num_envs, bool), False
        for _ in range(num_steps):
            kept = _copy(latest)
            returned = self.env.step(self.env.action_space.sample())
            _require(
                _equal(kept, latest), "what a call returned must not be overwritten by a later one"
            )
            done = self.check_step(returned)
            if self.mode is AutoresetMode.NEXT_STEP and ended.any():
                rule = "in mode NEXT_STEP, the step after the end of an episode must return"
                reward, terminated, truncated = map(np.asarray, returned[1:4])
                _require(not reward[ended].any(), f"{rule} reward 0")
                _require(not (terminated | truncated)[ended].any(), f"{rule} both flags False")
            if self.mode is AutoresetMode.SAME_STEP:
                self.check_final(returned[0], returned[4], done)
            if self.mode is AutoresetMode.DISABLED and done.any():
                self.reset_some(done, returned[0])
            any_ended |= bool(done.any())
            latest, ended = returned[:4], done
        if not any_ended:
            _warn(f"no episode ended within {num_steps} steps: autoreset was not checked")

    def check_reset(self, returned: Any) -> Any:
        obs, infos = returned
        _check_in_space(self.env.observation_space, obs, "the observation of reset()")
        self.check_infos(infos, "reset")
        return obs

    def check_step(self, returned: Any) -> np.ndarray:
        _require(
            isinstance(returned, tuple) and len(returned) == 5,
            "step() must return observations, rewards, terminated, truncated and infos",
        )
        _check_in_space(self.env.observation_space, returned[0], "the observation of step()")
        rewards, *flags = map(np.asarray, returned[1:4])
        _require(
            rewards.shape == (self.num_envs,) and rewards.dtype.kind == "f",
            f"rewards must be floats of shape ({self.num_envs},), are {_describe(rewards)}",
        )
        _require(bool(np.isfinite(rewards).all()), "rewards must be finite")
        self.check_bools("terminated", flags[0])
        self.check_bools("truncated", flags[1])
        self.check_infos(returned[4], "step")
        return flags[0] | flags[1]

    def check_bools(self, name: str, flags: np.ndarray) -> None:
        _require(
            flags.shape == (self.num_envs,) and flags.dtype == np.bool_,
            f"{name} must be bools of shape ({self.num_envs},), is {_describe(flags)}",
        )

    def check_infos(self, infos: Any, where: str) -> None:
        _require(isinstance(infos, dict), f"the infos of {where}() must be a dict")
        for name, value in infos.items():
            if name.startswith("_") and name[1:] in infos:
                continue
            _require(f"_{name}" in infos, f"infos[{name!r}] must have a mask infos['_{name}']")
            self.check_bools(f"infos['_{name}']", np.asarray(infos[f"_{name}"]))
            if name == "final_info":
                self.check_infos(value, where)
                continue
            _require(
                all(np.shape(leaf)[:1] == (self.num_envs,) for leaf in jax.tree.leaves(value)),
                f"infos[{name!r}] must have {self.num_envs} entries",
            )

    def check_final(self, obs: Any, infos: dict[str, Any], done: np.ndarray) -> None:
        for name in ("final_obs", "final_info"):
            mask = np.asarray(infos[f"_{name}"]) if name in infos else np.zeros_like(done)
            _require(
                np.array_equal(mask, done),
                f"in mode SAME_STEP, infos must have {name!r} exactly where an episode ended",
            )
        rule = "in mode SAME_STEP, the observation at the end of an episode must be the next one's"
        for i in np.flatnonzero(done):
            final, first = _rows(infos["final_obs"], i), _rows(obs, i)
            _check_in_space(self.env.single_observation_space, final, f"infos['final_obs'][{i}]")
            self.note_change(rule, final, first)

    def note_change(self, rule: str, before: Any, after: Any) -> None:
        self.changed[rule] = self.changed.get(rule, False) or not _equal(before, after)

    def reset_some(self, mask: np.ndarray, before: Any) -> None:
        """Reset where ``mask`` is True and compare with ``before``, the last observations."""
        rule = "reset(options={'reset_mask': mask}) must"
        kept, given = _copy(before), mask.copy()
        options = {"reset_mask": given}
        returned = self.env.reset(options=options)
        if options.get("reset_mask") is not given:
            _warn("reset() changed the caller's options; wrappers then see no reset_mask")
        _require(np.array_equal(given, mask), f"{rule} not write to the mask")
        obs = _copy(self.check_reset(returned))
        _require(
            _equal(_rows(kept, ~mask), _rows(obs, ~mask)),
            f"{rule} return the observations of the other environments as they were",
        )
        self.note_change(
            f"{rule} reset the masked environments", _rows(kept, mask), _rows(obs, mask)
        )

    def render(self) -> None:
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
            is_image = isinstance(image, np.ndarray) and image.dtype == np.uint8
            _require(
                is_image and image.ndim == 3 and image.shape[2] == 3,
                "render() must return uint8 NumPy arrays (height, width, 3)",
            )
        fps: Any = self.env.metadata.get("render_fps")
        _require(bool(fps) and fps > 0, f"metadata['render_fps'] must be positive, is {fps!r}")

    def close(self) -> None:
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


def _copy(tree: Any) -> Any:
    """Copy arrays to host memory."""
    return jax.tree.map(lambda x: np.array(np.asarray(x)), tree)


def _rows(tree: Any, which: Any) -> Any:
    return jax.tree.map(lambda x: x[which], tree)


def _equal(one: Any, other: Any) -> bool:
    left, right = jax.tree.leaves(one), jax.tree.leaves(other)
    return len(left) == len(right) and all(map(np.array_equal, left, right))


def _describe(array: np.ndarray) -> str:
    return f"{array.dtype} of shape {array.shape}"


def _check_in_space(space: spaces.Space, value: Any, what: str) -> None:
    if isinstance(space, spaces.Dict):
        _require(
            isinstance(value, dict) and set(value) == set(space.spaces),
            f"{what} must be a dict of {', '.join(space.spaces)}",
        )
        for name, part in space.spaces.items():
            _check_in_space(part, value[name], f"{what}, entry {name!r},")
        return
    if isinstance(space, spaces.Box):
        value = np.asarray(value)
        _require(
            value.shape == space.shape and value.dtype == space.dtype,
            f"{what} must be {space.dtype} of shape {space.shape}, is {_describe(value)}",
        )
    _require(value in space, f"{what} must lie in {space}")
