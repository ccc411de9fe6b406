"""Provide many pixel environments as a Stable-Baselines3 ``VecEnv``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium
import jax
import numpy as np

from pixelbrax_jax.extras import needs_extra

with needs_extra("sb3", "Stable-Baselines3 is not installed"):
    from stable_baselines3.common.vec_env import VecEnv

from pixelbrax_gym.gymnasium.spaces import action_space, channels_first_space, observation_space
from pixelbrax_gym.interop.export import to_numpy
from pixelbrax_gym.resets import SEEDS, spread_seeds
from pixelbrax_gym.stateful import StatefulEnv
from pixelbrax_gym.sub_env import SubEnv, call_sub_envs
from pixelbrax_jax import PixelEnv
from pixelbrax_jax.validation import check_bool, check_choice


def check_channels(env: PixelEnv, channels_first: bool) -> None:
    """Reject images for which Stable-Baselines3 would take rows or columns for channels."""
    if "pixels" not in env.images:
        return
    cameras = 1 if env.camera_sizes else env.num_cameras
    channels = 3 * env.frame_stack * cameras
    for name, (height, width) in (env.image_sizes or {"": (env.height, env.width)}).items():
        if min(height, width) < channels if channels_first else height <= min(width, channels):
            what = f"camera_sizes[{name!r}]={height, width}" if name else f"{height=}, {width=}"
            several = f", {cameras} cameras" if cameras > 1 else ""
            raise ValueError(
                f"{what}{several} and frame_stack={env.frame_stack} make images with {channels} "
                "channels, but Stable-Baselines3 takes the shortest axis of an image for its "
                f"channels: use a height and width above {channels} pixels, or stack fewer frames."
            )


class SB3VecEnv(VecEnv):
    """``num_envs`` copies of a pixel task, stepped together.

    Results are NumPy arrays, with autoreset in the same step. ``infos[i]`` has
    ``TimeLimit.truncated``; where an episode ended it also has ``terminal_observation``,
    ``episode_return`` (sum of rewards), ``episode_length`` (control steps) and ``non_finite``
    (the physics diverged and ended the episode).

    Observations share memory with JAX on a CPU and are copied from other devices. They may be
    written to. The same seed gives the same episodes as in a ``GymnasiumVectorEnv``. ``get_attr``,
    ``set_attr`` and ``env_method`` address a ``SubEnv`` for each environment. Methods raise
    ``ClosedEnvironmentError`` after ``close`` and ``RuntimeError`` in a fork that cannot run JAX.

    Examples:
        >>> env = VecMonitor(SB3VecEnv("inverted_pendulum", num_envs=64))
        >>> PPO("CnnPolicy", env).learn(100_000)
    """

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        render_mode: str | None = None,
        render_height: int = 480,
        render_width: int = 480,
        channels_first: bool = False,
        stagger: bool = False,
        max_episode_steps: int | None = None,
        **options: Any,
    ) -> None:
        """Build the environments; the first ``reset`` compiles.

        Args:
            task: one of ``pixelbrax_jax.list_envs()``.
            num_envs: N, at least 1.
            render_mode: None or ``"rgb_array"``.
            render_height: height of ``render()`` in pixels.
            render_width: width of ``render()`` in pixels.
            channels_first: whether images are (3K, H, W), as a view, instead of (H, W, 3K), which
                Stable-Baselines3 transposes itself.
            stagger: whether to spread time limits evenly over the steps, because
                Stable-Baselines3 evaluates the value function once for each truncated environment.
                Environment i's first episode after a full reset is shorter by ``i / N`` of the
                limit.
            max_episode_steps: time limit in calls of ``step``; None keeps ``episode_length``,
                1000 control steps by default.
            **options: other options of ``pixelbrax_jax.make``, such as ``camera``.

        Raises:
            TypeError: an option is unknown.
            ValueError: an option is out of range, or Stable-Baselines3 would read rows or columns
                as channels because there are at least as many channels.
        """
        if render_mode is not None:
            check_choice("render_mode", render_mode, ("rgb_array",))
        self._channels_first = check_bool("channels_first", channels_first)
        stagger = check_bool("stagger", stagger)
        self._stateful = StatefulEnv(
            SB3VecEnv,
            task,
            options,
            num_envs=num_envs,
            autoreset_mode="same_step",
            max_episode_steps=max_episode_steps,
            render_size=(render_height, render_width),
        )
        env, num_envs = self._stateful.env, self._stateful.num_envs
        space = observation_space(env.obs_spec)
        space = channels_first_space(space) if channels_first else space
        check_channels(env, channels_first)
        spaces = (space, action_space(env.action_size))
        # Stable-Baselines3's constructor reads the render mode of the sub-environments.
        self.render_mode = render_mode
        self._sub_envs = [SubEnv(self, i, *spaces) for i in range(num_envs)]
        super().__init__(num_envs, *spaces)
        # SB3's wrappers read this number.
        self.metadata: dict[str, Any] = self.metadata | {"render_fps": self._stateful.fps}
        offsets = np.arange(num_envs) * self._stateful.episode_length // num_envs
        self._time_limit_offsets = offsets.astype(np.int32) if stagger else None
        self._actions: Any = None

    def reset(self) -> Any:
        """Start the next episode everywhere, or episode 0 after ``seed``; return observations.

        Raises:
            ValueError: ``set_options`` was called; no options exist. They are dropped.
        """
        given = self._options
        # The next reset must not fail again.
        self._reset_options()
        for options in filter(None, given):
            raise ValueError(
                f"reset() takes no options, got {', '.join(map(repr, options))}; use seed() for a "
                "seed and give other options when you make the environment."
            )
        outputs = self._stateful.reset(self._seeds, time_limit_offsets=self._time_limit_offsets)
        self._reset_seeds()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return self._observations(outputs["obs"])

    def seed(self, seed: int | None = None) -> Sequence[int]:
        """Seed environment i with ``seed + i`` modulo 2**32 at the next reset; return the N seeds.

        None samples a seed from NumPy's global generator.
        """
        if seed is None:
            seed = int(np.random.randint(SEEDS, dtype=np.uint64))  # noqa: NPY002  # as SB3 does
        seeds = spread_seeds(seed, self.num_envs)
        self._seeds = list(seeds)
        return seeds

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions, (N, A) floating point; ``step_wait`` clips them to [-1, 1]."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step all environments; return observations, (N,) float32 rewards, (N,) bool dones, infos.

        Raises:
            ResetNeeded: before the first reset.
            TypeError: the actions are not floating point.
            ValueError: the actions have another shape or contain a NaN; nothing was stepped.
        """
        outputs = self._stateful.step(self._actions)
        dones, rewards = np.array(outputs["done"]), np.array(outputs["reward"])
        truncated = np.asarray(outputs["truncated"]).tolist()
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": value} for value in truncated]
        if dones.any():
            self._describe_ends(infos, np.flatnonzero(dones), outputs["info"])
        return self._observations(outputs["obs"]), rewards, dones, infos

    def _describe_ends(self, infos: list[dict[str, Any]], rows: np.ndarray, info: Any) -> None:
        last = self._observations(info["final_obs"])
        final = {name: np.array(value) for name, value in info["final_info"].items()}
        for i in rows:
            # A copy: a view would keep the frames of all environments alive.
            infos[i]["terminal_observation"] = jax.tree.map(lambda x, i=i: x[i].copy(), last)
            infos[i] |= {
                name: value[i].copy() if value.ndim > 1 else value[i].item()
                for name, value in final.items()
            }

    def get_images(self) -> list[np.ndarray | None]:
        """Return N images (render_height, render_width, 3) uint8; None without a render mode."""
        if self.render_mode is None:
            return [None] * self.num_envs
        return list(to_numpy(self._stateful.render()))

    def close(self) -> None:
        """Release the states."""
        self._stateful.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the sub-environments."""
        return [getattr(sub_env, attr_name) for sub_env in self._selected(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the sub-environments; the environments themselves ignore it."""
        for sub_env in self._selected(indices):
            setattr(sub_env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the sub-environments and return its results."""
        sub_envs = self._selected(indices)
        return call_sub_envs(sub_envs, method_name, *method_args, **method_kwargs)

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper], indices: Any = None
    ) -> list[bool]:
        """Return False for all, because sub-environments have no wrappers."""
        del wrapper_class
        return [False for _ in self._selected(indices)]

    def _selected(self, indices: int | Iterable[int] | None) -> list[SubEnv]:
        return [self._sub_envs[i] for i in self._get_indices(indices)]

    def _observations(self, obs: Any) -> Any:
        arrays = to_numpy(obs)
        if not self._channels_first:
            return arrays
        return jax.tree.map(lambda x: x.transpose(0, 3, 1, 2) if x.ndim == 4 else x, arrays)
