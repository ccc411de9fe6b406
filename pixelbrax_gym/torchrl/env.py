"""Provide many pixel environments as a TorchRL environment."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import error

from pixelbrax_jax.extras import needs_extra

with needs_extra("torchrl", "TorchRL is not installed"):
    import torch
    from tensordict import TensorDict, TensorDictBase
    from torchrl.data import Bounded, Unbounded
    from torchrl.envs import EnvBase

from pixelbrax_gym.interop.actions import name_rows
from pixelbrax_gym.interop.dlpack import as_device, default_torch_device, to_torch
from pixelbrax_gym.interop.fork import check_not_forked
from pixelbrax_gym.programs import Stepped
from pixelbrax_gym.resets import SEEDS, as_mask, spread_seeds
from pixelbrax_gym.stateful import StatefulEnv
from pixelbrax_gym.torchrl.specs import done_spec, entries, observation_spec


class TorchRLEnv(EnvBase):
    """``num_envs`` copies of a pixel task, stepped together.

    Batch size (N,). Keys: ``pixels``, (N, H, W, 3K) uint8, oldest frame first, ``depth`` and
    ``segmentation`` as ``obs_mode`` asks (with ``camera_sizes`` such as ``pixels/top``);
    ``observation``, (N, S) float32, the state; ``action``, (N, A) float32 in [-1, 1]; ``reward``,
    (N, 1) float32; ``done``, ``terminated`` and ``truncated``, (N, 1) bool.

    The step that ends an episode returns its last observation under ``"next"``. The same program
    resets the environment; ``reset`` then returns the first observation for the rows of its
    ``"_reset"`` mask, as TorchRL's collectors and rollouts request. Other rows keep their state.

    Tensors share memory with JAX arrays that are not read again, so in-place operations are safe.
    The same seed gives the same episodes as in a ``GymnasiumVectorEnv``. Methods raise
    ``ClosedEnvironmentError`` after ``close`` and ``RuntimeError`` in a fork that cannot run JAX.

    Attributes:
        infos: tensors with leading axis N about the episodes of the last step:
            ``episode_return`` (sum of rewards), ``episode_length`` (control steps),
            ``non_finite`` (the physics diverged and ended the episode) and those of distractors.
            Rows that a partial step leaves out keep theirs, 0 before their first step.

    Examples:
        >>> env = TorchRLEnv("ant", num_envs=256)
        >>> env.set_seed(0)
        >>> rollout = env.rollout(10, break_when_any_done=False)
    """

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        device: torch.device | str | None = None,
        render_height: int = 480,
        render_width: int = 480,
        **options: Any,
    ) -> None:
        """Build the environments; the first ``reset`` compiles.

        Args:
            task: one of ``pixelbrax_jax.list_envs()``.
            num_envs: N, at least 1.
            device: device of the tensors; None means JAX's default device. Tensors are copied to
                and from any other device.
            render_height: height of ``render()`` in pixels.
            render_width: width of ``render()`` in pixels.
            **options: other options of ``pixelbrax_jax.make``, such as ``camera``.

        Raises:
            TypeError: an option is unknown.
            ValueError: an option is out of range.
        """
        check_not_forked()
        stateful = StatefulEnv(
            TorchRLEnv,
            task,
            options,
            num_envs=num_envs,
            autoreset_mode="same_step",
            render_size=(render_height, render_width),
        )
        self._jax_device = default_torch_device()
        device = self._jax_device if device is None else as_device(device)
        super().__init__(device=device, batch_size=(stateful.num_envs,))
        self.is_closed = False
        self.infos: dict[str, torch.Tensor] = {}
        self._task, self._stateful, self._num_envs = task, stateful, stateful.num_envs
        # Seeds of environments whose next reset starts episode 0 of a seed; None for the others.
        self._seeds: list[int | None] | None = None

        env, size = stateful.env, (self._num_envs, self.device)
        self.observation_spec = observation_spec(env.obs_spec, env.images, *size)
        shape = (self._num_envs, env.action_size)
        self.action_spec = Bounded(-1.0, 1.0, shape, device=self.device, dtype=torch.float32)
        self.reward_spec = Unbounded((self._num_envs, 1), device=self.device, dtype=torch.float32)
        self.done_spec = done_spec(*size)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        if kwargs:
            raise TypeError(
                f"reset() takes no {', '.join(kwargs)}; give seeds to set_seed() and other options "
                "when you make the environment."
            )
        mask = np.ones(self._num_envs, bool)
        given = None if tensordict is None else tensordict.get("_reset", None)
        if given is not None:
            mask = self._mask("'_reset'", given)
        if self._seeds is None and self._stateful.extra is None:  # the first reset
            self._set_seed(None)
        seeds = None
        first_obs, was_reset = self._begun
        left = was_reset & ~mask
        # Rows that the last step reset are not reset again, unless they get a new seed.
        to_reset = mask & ~was_reset
        if self._seeds is not None:
            seeds = [seed if here else None for seed, here in zip(self._seeds, mask, strict=True)]
            to_reset |= np.array([seed is not None for seed in seeds])
        # Observations are handed out once, because the receiver may write to them.
        if to_reset.any() or first_obs is None:
            outputs = self._stateful.reset(seeds, mask=to_reset, keep=lambda _: (None, left))
            first_obs = outputs["obs"]
        else:
            self._stateful.replace_extra((None, left))
        if self._seeds is not None:
            later = [None if here else seed for seed, here in zip(self._seeds, mask, strict=True)]
            self._seeds = later if any(seed is not None for seed in later) else None
        obs = entries(to_torch(first_obs), self._stateful.env.images)
        return self._tensordict({**obs, **self.full_done_spec.zero()})

    @property
    def _begun(self) -> tuple[Any, np.ndarray]:
        """Return the first observations of episodes that the last step began, and their (N,) mask.

        Both are replaced together with the state, so an exception cannot separate them.
        """
        first_obs, where = self._stateful.extra or (None, np.zeros(self._num_envs, bool))
        return first_obs, np.asarray(where)

    def _reset_proc_data(
        self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        """Take observations of all rows from ``_reset``, because TorchRL would copy every image.

        TorchRL's row-wise choice is only needed while an ended episode keeps its last observation.
        """
        if tensordict is None or np.any(self._begun[1]):
            return super()._reset_proc_data(tensordict, tensordict_reset)
        names = list(self.observation_spec.keys())
        rest = super()._reset_proc_data(
            tensordict.exclude(*names), tensordict_reset.exclude(*names)
        )
        tensordict.pop("_reset", None)
        return tensordict.update(rest).update(tensordict_reset.select(*names))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        where = tensordict.get("_step", None)
        mask = None if where is None else self._mask("'_step'", where)
        action = tensordict.get("action", None)
        if action is None:
            raise ValueError(
                "step() needs an entry 'action' in its tensordict; a policy or "
                "env.rand_action(tensordict) writes it."
            )
        began = self._begun[1]
        ended = began if mask is None else began & mask
        if ended.any():
            raise error.ResetNeeded(
                f"the episode of environment {name_rows(ended)} has ended; call reset() with "
                "their '_reset' True before the next step(). If a transform steps several times "
                "in a row, use action_repeat instead."
            )

        def begun(stepped: Stepped) -> tuple[Any, Any]:
            where = stepped.ended if mask is None else began | np.asarray(stepped.ended)
            return stepped.outputs["obs"], where

        outputs = self._stateful.step(action.to(self._jax_device), mask, keep=begun)
        infos = outputs["info"]
        names = ("reward", "done", "terminated", "truncated")
        exported = to_torch(
            {
                "obs": infos["final_obs"],
                "infos": infos["final_info"],
                **{name: outputs[name] for name in names},
            }
        )
        new_infos = {name: x.to(self.device) for name, x in exported["infos"].items()}
        values = {name: exported[name][:, None] for name in names}
        values |= entries(exported["obs"], self._stateful.env.images)
        if where is not None:
            rows = where.reshape(self._num_envs)
            values = _keep_unstepped(values, tensordict, rows)
            new_infos = _keep_unstepped(new_infos, self.infos, rows)
        self.infos = new_infos
        return self._tensordict(values)

    def _set_seed(self, seed: int | None) -> None:
        """Seed environment i with ``seed + i`` at its next reset; torch samples a seed for None."""
        if seed is None:
            seed = int(torch.randint(SEEDS, ()))
        self._seeds = list(spread_seeds(seed, self._num_envs))

    def render(self) -> torch.Tensor:
        """Render (N, render_height, render_width, 3) uint8 images, row 0 at the top.

        Raises:
            ResetNeeded: before the first reset.
        """
        return to_torch(self._stateful.render()).to(self.device)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Release the states."""
        del raise_if_closed
        self.is_closed = True
        # TorchRL also closes an environment whose construction failed.
        if "_stateful" in self.__dict__:
            self._stateful.close()

    def _mask(self, what: str, given: torch.Tensor) -> np.ndarray:
        return as_mask(what, given.reshape(self._num_envs), (self._num_envs,))

    def __repr__(self) -> str:
        name = type(self).__name__
        return f"{name}({self._task!r}, num_envs={self._num_envs}, device={self.device})"

    def _tensordict(self, values: dict[str, torch.Tensor]) -> TensorDict:
        return TensorDict(values, batch_size=self.batch_size, device=self.device)


def _keep_unstepped(
    values: dict[str, torch.Tensor],
    before: TensorDictBase | dict[str, torch.Tensor],
    where: torch.Tensor,
) -> dict[str, torch.Tensor]:
    """Return ``values``; rows without a step keep the previous ones, or 0, with reward 0."""

    def choose(name: str, value: torch.Tensor) -> torch.Tensor:
        old = before.get(name, None) if name != "reward" else None
        old = torch.zeros_like(value) if old is None else old.to(value.device)
        here = where.to(value.device).reshape(-1, *[1] * (value.ndim - 1))
        return torch.where(here, value, old)

    return {name: choose(name, value) for name, value in values.items()}
