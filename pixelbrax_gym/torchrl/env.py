"""Many pixel environments in one compiled program, as a TorchRL environment."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import error

from pixelbrax_jax.extras import install_extra

try:
    import torch
    from tensordict import TensorDict, TensorDictBase
    from torchrl.data import Unbounded
    from torchrl.envs import EnvBase
except ImportError as missing:
    raise ImportError(f"TorchRL is not installed; try: {install_extra('torchrl')}") from missing

from pixelbrax_gym.interop.actions import name_rows
from pixelbrax_gym.interop.dlpack import as_device, default_torch_device, to_torch
from pixelbrax_gym.interop.fork import check_not_forked
from pixelbrax_gym.programs import Stepped
from pixelbrax_gym.resets import SEEDS, as_mask, spread_seeds
from pixelbrax_gym.stateful import StatefulEnv
from pixelbrax_gym.torchrl.specs import action_spec, done_spec, observation_spec


class TorchRLEnv(EnvBase):
    """``num_envs`` copies of a Brax task seen through a camera, stepped together.

    Batch size (N,). Keys: ``pixels``, (N, H, W, 3K) uint8, oldest frame first; ``observation``,
    (N, S) float32, with ``obs_mode="state"`` or ``"both"``; ``action``, (N, A) float32 in
    [-1, 1]; ``reward``, (N, 1) float32; ``done``, ``terminated`` and ``truncated``, (N, 1) bool.

    The step that ends an episode returns its true last observation under ``"next"``. The same
    compiled program has reset the environment by then and drawn the first frame, which
    ``reset`` hands out for the rows that its ``"_reset"`` mask names; TorchRL's collectors and
    rollouts do so by themselves. All other rows keep their state.

    Tensors share memory with what JAX has computed. Nothing reads that again, hence an in-place
    operation changes nothing that comes later.

    Environment i seeded with s draws what environment i of a ``GymnasiumVectorEnv`` seeded with
    s draws.

    Attributes:
        infos: after a step, a dict of tensors of leading axis N about the episodes that the
            step belongs to: ``episode_return`` (sum of rewards), ``episode_length`` (control
            steps), ``non_finite`` (the physics diverged and ended the episode), and what
            distractors add.

    Example:
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
            device: where tensors are. None means JAX's default device, from which nothing is
                copied; tensors are copied to and from any other device.
            render_height: pixels of ``render()``.
            render_width: pixels of ``render()``.
            **options: everything else that ``pixelbrax_jax.make`` takes, such as ``backend``,
                ``camera``, ``height``, ``width``, ``frame_stack``, ``obs_mode``,
                ``action_repeat`` and ``episode_length``.

        Raises:
            TypeError: an option is unknown; the message lists those there are.
            ValueError: an option is out of range; the message lists what is allowed.
            RuntimeError: this process is a fork that cannot run JAX.
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
        # Of environments whose next reset shall be to episode 0 of a seed; else None.
        self._seeds: list[int | None] | None = None
        self._is_seeded = False

        env, size = stateful.env, (self._num_envs, self.device)
        self.observation_spec = observation_spec(env.obs_spec, *size)
        self.action_spec = action_spec(env.action_size, *size)
        self.reward_spec = Unbounded((self._num_envs, 1), device=self.device, dtype=torch.float32)
        self.done_spec = done_spec(*size)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        if kwargs:
            raise TypeError(
                f"reset() takes no {', '.join(kwargs)}; seeds are given by set_seed(), everything "
                "else when the environment is made."
            )
        mask = np.ones(self._num_envs, bool)
        given = None if tensordict is None else tensordict.get("_reset", None)
        if given is not None:
            mask = self._mask("'_reset'", given)
        if not self._is_seeded:
            self._set_seed(None)
        seeds = None
        first_obs, was_reset = self._begun
        left = was_reset & ~mask
        # What was reset already is not reset twice, unless it shall have another seed.
        to_reset = mask & ~was_reset
        if self._seeds is not None:
            seeds = [seed if here else None for seed, here in zip(self._seeds, mask, strict=True)]
            to_reset |= np.array([seed is not None for seed in seeds])
        # Handed out once, and so never shared by two who might write to it.
        if to_reset.any() or first_obs is None:
            outputs = self._stateful.reset(seeds, mask=to_reset, keep=lambda _: (None, left))
            first_obs = outputs["obs"]
        else:
            self._stateful.replace_extra((None, left))
        if self._seeds is not None:
            later = [None if here else seed for seed, here in zip(self._seeds, mask, strict=True)]
            self._seeds = later if any(seed is not None for seed in later) else None
        return self._tensordict(self._observations(to_torch(first_obs)) | self._flags())

    @property
    def _begun(self) -> tuple[Any, np.ndarray]:
        """Of the last step: first observations of the episodes that it began; where it began any.

        Kept with the state, so that an exception at any time leaves the two in step.
        """
        first_obs, where = self._stateful.extra or (None, np.zeros(self._num_envs, bool))
        return first_obs, np.asarray(where)

    def _reset_proc_data(
        self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        """Do as TorchRL does, apart from observations.

        `_reset` returns those of all environments, also of the ones that go on. TorchRL would
        choose between old and new ones row by row, and copy every image for it. That is only
        needed while some ended episode keeps its last observation. Rows that go on therefore show
        what the environment shows, also if the caller had changed them. A ``TransformedEnv``
        chooses, and copies, by itself.
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
                "step() needs an entry 'action' in its tensordict; a policy writes it, or "
                "env.rand_action(tensordict)."
            )
        began = self._begun[1]
        ended = began if mask is None else began & mask
        if ended.any():
            raise error.ResetNeeded(
                f"the episode of environment {name_rows(ended)} has ended; call reset() with "
                "their '_reset' True before the next step(). Should a transform step several "
                "times in a row, use action_repeat instead."
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
        self.infos = exported["infos"]
        values = {name: exported[name][:, None] for name in names}
        values |= self._observations(exported["obs"])
        if where is not None:
            values = _keep_unstepped(values, tensordict, where.reshape(self._num_envs))
        return self._tensordict(values)

    def _set_seed(self, seed: int | None) -> None:
        """Let environment i draw from ``seed + i`` from its next reset on; torch draws for None."""
        if seed is None:
            seed = int(torch.randint(SEEDS, ()))
        self._seeds = list(spread_seeds(seed, self._num_envs))
        self._is_seeded = True

    def render(self) -> torch.Tensor:
        """Draw the present states, e.g. for TorchRL's ``PixelRenderTransform``.

        Returns:
            (N, render_height, render_width, 3) uint8, row 0 at the top.

        Raises:
            ResetNeeded: before the first reset.
            ClosedEnvironmentError: after ``close``.
        """
        return to_torch(self._stateful.render()).to(self.device)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Forget the states."""
        del raise_if_closed
        self.is_closed = True
        # TorchRL also closes an environment whose construction failed.
        if "_stateful" in self.__dict__:
            self._stateful.close()

    def _mask(self, what: str, given: torch.Tensor) -> np.ndarray:
        return as_mask(what, given.reshape(self._num_envs), (self._num_envs,))

    def __repr__(self) -> str:
        """Name the task, the number of environments and the device."""
        name = type(self).__name__
        return f"{name}({self._task!r}, num_envs={self._num_envs}, device={self.device})"

    def _observations(self, obs: Any) -> dict[str, torch.Tensor]:
        if not isinstance(obs, dict):
            return {"pixels" if obs.dtype == torch.uint8 else "observation": obs}
        return {"pixels": obs["pixels"], "observation": obs["state"]}

    def _flags(self) -> dict[str, torch.Tensor]:
        names = ("done", "terminated", "truncated")
        shape = (self._num_envs, 1)
        return {name: torch.zeros(shape, dtype=torch.bool, device=self.device) for name in names}

    def _tensordict(self, values: dict[str, torch.Tensor]) -> TensorDict:
        return TensorDict(values, batch_size=self.batch_size, device=self.device)


def _keep_unstepped(
    values: dict[str, torch.Tensor], before: TensorDictBase, where: torch.Tensor
) -> dict[str, torch.Tensor]:
    """Return ``values``; what was before, and no reward, where nothing was stepped."""

    def choose(name: str, value: torch.Tensor) -> torch.Tensor:
        old = before.get(name, None) if name != "reward" else None
        old = torch.zeros_like(value) if old is None else old.to(value.device)
        here = where.to(value.device).reshape(-1, *[1] * (value.ndim - 1))
        return torch.where(here, value, old)

    return {name: choose(name, value) for name, value in values.items()}
