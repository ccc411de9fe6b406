"""Environments on several devices and processes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax
from jax.sharding import AxisType, Mesh, PartitionSpec

from pixelbrax_jax.envs.param_rows import split_params
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.flags import under_environment_flags
from pixelbrax_jax.types import EnvParams, EnvState, Timestep
from pixelbrax_jax.validation import check_positive_int

AXIS = "envs"
"""Name of the mesh axis of environments."""


def make_env_mesh(num_devices: int | None = None) -> Mesh:
    """Make a mesh of devices, by default all of all processes, along the axis ``"envs"``."""
    num_devices = jax.device_count() if num_devices is None else num_devices
    return jax.make_mesh((num_devices,), (AXIS,), axis_types=(AxisType.Auto,))


@dataclass(frozen=True)
class ShardedVectorEnv:
    """A ``VectorPixelEnv`` with the same number of environments on each device of a mesh.

    Devices exchange no data while they step. Environment i is the same as without sharding.

    Attributes:
        env: the environment.
        num_envs: N, over all devices; a multiple of their number.
        mesh: the devices, from `make_env_mesh`.
        autoreset_mode: as in ``VectorPixelEnv``.

    Raises:
        ValueError: a field is out of range, or the environments cannot be divided evenly.
        MemoryError: observations do not fit into this machine's memory.
    """

    env: PixelEnv
    num_envs: int
    mesh: Mesh
    autoreset_mode: str = "next_step"

    def __post_init__(self) -> None:
        num_envs, size = check_positive_int("num_envs", self.num_envs), self.mesh.shape[AXIS]
        if num_envs % size:
            raise ValueError(f"num_envs={num_envs} must be a multiple of the {size} devices.")
        object.__setattr__(self, "num_envs", num_envs)
        _ = self._local  # It checks the other fields.

    @partial(jax.jit, static_argnums=0)
    @under_environment_flags
    def reset(self, key: jax.Array, params: EnvParams) -> tuple[EnvState, Timestep]:
        """See ``VectorPixelEnv.reset``."""
        keys = self._local.env_keys(key, self.num_envs)
        return self._shard(self._local.reset, 1, params)(keys, params)

    @partial(jax.jit, static_argnums=0)
    @under_environment_flags
    def step(
        self, state: EnvState, action: jax.Array, params: EnvParams
    ) -> tuple[EnvState, Timestep]:
        """See ``VectorPixelEnv.step``."""
        return self._shard(self._local.step, 2, params)(state, action, params)

    def obs(self, state: EnvState) -> Any:
        """Return the observations of the states, with a leading axis N."""
        return self._local.obs(state)

    @cached_property
    def _local(self) -> VectorPixelEnv:
        num_envs = self.num_envs // self.mesh.shape[AXIS]
        return VectorPixelEnv(self.env, num_envs, self.autoreset_mode)

    def _shard(
        self, fn: Callable[..., Any], num_spread: int, params: EnvParams
    ) -> Callable[..., Any]:
        """Run ``fn`` on each device with its rows of the first arguments and of the params."""
        spread, same = PartitionSpec(AXIS), PartitionSpec()
        rows = split_params(params, self.num_envs)
        # The checker does not support loops and branches that differ between devices.
        return jax.shard_map(
            fn,
            mesh=self.mesh,
            in_specs=(spread,) * num_spread + (rows.mark(spread, same),),
            out_specs=spread,
            check_vma=False,
        )
