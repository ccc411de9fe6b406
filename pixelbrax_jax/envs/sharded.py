"""Environments spread over several devices, or over those of several processes."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
from jax.sharding import AxisType, Mesh, PartitionSpec

from pixelbrax_jax.choices import check_whole
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.types import EnvParams, EnvState, Timestep

AXIS = "envs"
"""Name of the mesh axis along which environments are spread."""


def make_env_mesh(num_devices: int | None = None) -> Mesh:
    """A mesh of devices along the axis ``"envs"``, whose shardings the compiler propagates.

    Args:
        num_devices: how many; None takes all, those of other processes too.
    """
    num_devices = jax.device_count() if num_devices is None else num_devices
    return jax.make_mesh((num_devices,), (AXIS,), axis_types=(AxisType.Auto,))


class ShardedVectorEnv:
    """``VectorPixelEnv`` with equally many environments on each device of a mesh.

    Each device steps its own; nothing crosses between them. Environment i is the same as without
    sharding.

    Attributes:
        env: the environment.
        num_envs: N, over all devices.
        mesh: the devices, along an axis ``"envs"``.
        autoreset_mode: as of ``VectorPixelEnv``.
    """

    def __init__(
        self, env: PixelEnv, num_envs: int, mesh: Mesh, autoreset_mode: str = "next_step"
    ) -> None:
        """Checks the options.

        Args:
            env: the environment.
            num_envs: N, a multiple of the number of devices.
            mesh: of `make_env_mesh`.
            autoreset_mode: as of ``VectorPixelEnv``.

        Raises:
            ValueError: the environments cannot be spread evenly.
        """
        self.env = env
        self.num_envs = check_whole("num_envs", num_envs)
        self.mesh = mesh
        self.autoreset_mode = autoreset_mode
        size = mesh.shape[AXIS]
        if num_envs % size:
            raise ValueError(f"num_envs={num_envs} must be a multiple of the {size} devices.")
        self._here = VectorPixelEnv(env, num_envs // size, autoreset_mode)
        spread, same = PartitionSpec(AXIS), PartitionSpec()
        # Loops and branches inside differ between devices, which the checker cannot follow.
        shard = partial(jax.shard_map, mesh=mesh, out_specs=spread, check_vma=False)
        self._reset = shard(self._here.reset, in_specs=(spread, same))
        self._step = shard(self._here.step, in_specs=(spread, spread, same))

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: jax.Array, params: EnvParams) -> tuple[EnvState, Timestep]:
        """As ``VectorPixelEnv.reset``, of one key."""
        result: tuple[EnvState, Timestep] = self._reset(
            self._here.keys_of(key, self.num_envs), params
        )
        return result

    @partial(jax.jit, static_argnums=0)
    def step(
        self, state: EnvState, action: jax.Array, params: EnvParams
    ) -> tuple[EnvState, Timestep]:
        """As ``VectorPixelEnv.step``."""
        result: tuple[EnvState, Timestep] = self._step(state, action, params)
        return result

    def obs(self, state: EnvState) -> Any:
        """Observations of the states, with a leading axis N."""
        return self._here.obs(state)
