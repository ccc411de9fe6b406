"""Pixel environments for Brax's trainers."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.flags import is_key
from pixelbrax_jax.physics.mujoco.compatibility import accept_device_put_replicated, import_silenced
from pixelbrax_jax.types import EnvParams, Timestep

with import_silenced():
    from brax.envs.base import Env, State, Wrapper
    from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper

PIXELS = "pixels/view_0"
"""Name of the image in an observation; Brax treats entries named ``pixels/...`` as images."""

_LEVEL = np.float32(1 / 255)
"""Factor of pixels, because XLA may round a division by a constant differently."""

_NO_LIMIT = 2**31 - 1
"""More control steps than any episode has."""


class BraxEnv(Env):
    """A ``PixelEnv`` with its parameters as a ``brax.envs.Env``.

    As in Brax, the environment has no time limit: ``done`` is the task's termination, and Brax's
    ``EpisodeWrapper`` counts calls of ``step`` and sets ``info["truncation"]`` at the trainer's
    ``episode_length``. Repeat actions with ``action_repeat`` of the pixel environment: Brax's
    renders frames that nobody sees, and continues after a termination.

    Brax's ``AutoResetWrapper`` resets every episode to the state of the first one;
    ``wrap_fresh_episodes`` resets to a new one.

    Examples:
        >>> env = BraxEnv(*pixelbrax_jax.make("inverted_pendulum"))
        >>> ppo.train(env, 1_000_000, episode_length=env.episode_length, ...)

    Attributes:
        env: the pixel environment.
        sys: its ``EnvParams`` without a time limit, under the name that Brax's ``randomization_fn``
            expects; it may randomise them per environment.
        episode_length: time limit of the given parameters, in calls of ``step``.
    """

    def __init__(self, env: PixelEnv, params: EnvParams) -> None:
        """Wrap ``env``, which is not modified.

        Raises:
            TypeError: it is not a ``PixelEnv``.
            ValueError: its observations have depth or segmentation.
        """
        if not isinstance(env, PixelEnv):
            raise TypeError(f"env must be a PixelEnv, got {type(env).__name__}.")
        if env.camera_sizes:
            raise ValueError(
                "camera_sizes are not for Brax's trainers, whose cameras share height and width: "
                "leave them out."
            )
        if env.images not in ((), ("pixels",)):
            raise ValueError(
                f"obs_mode={env.obs_mode!r} is not for Brax's trainers, whose images are pixels: "
                "use 'pixels', 'state' or 'both'."
            )
        _patch_trainers()
        self.env = env
        self.sys = params.replace(episode_length=jax.device_put(np.int32(_NO_LIMIT)))
        self.episode_length = -(-int(params.episode_length) // env.action_repeat)

    def reset(self, rng: jax.Array) -> State:
        """Reset to episode 0 of the environment with the key ``rng``, typed or uint32 like Brax's.

        ``State.pipeline_state`` is an ``EnvState``. Raises TypeError if ``rng`` is not one key.
        """
        if isinstance(rng, jax.Array | np.ndarray) and not is_key(rng.dtype):
            rng = jax.random.wrap_key_data(rng)
        state, timestep = self.env.reset(rng, self.sys)
        return State(pipeline_state=state, **self._fields(timestep))

    def step(self, state: State, action: jax.Array) -> State:
        """Step with an action (A,) float, clipped to [-1, 1], and render one frame.

        Returns:
            The next state. ``done`` is 1 if the task ended; ``metrics["non_finite"]`` is 1 if it
            ended because the physics diverged, so its sum over an episode is 0 or 1.

        Raises:
            ValueError: ``action`` has another shape.
            TypeError: ``action`` is not floating point.
        """
        pipeline, timestep = self.env.step(state.pipeline_state, action, self.sys)
        fields = self._fields(timestep)
        # Brax's wrappers add their own metrics.
        fields["metrics"] = {**state.metrics, **fields["metrics"]}
        return state.replace(pipeline_state=pipeline, **fields)

    def observation(self, obs: Any) -> Any:
        """Return an observation of one or many pixel environments in Brax's form.

        It is the array itself with ``obs_mode="state"``. Otherwise it is a dictionary with the
        image, (..., H, W, 3K) float32 in [0, 1], as ``"pixels/view_0"``, and with ``"both"`` the
        (..., S) float32 state as ``"state"``.
        """
        if self.env.obs_mode == "state":
            return obs
        if self.env.obs_mode == "pixels":
            obs = {"pixels": obs}
        pixels = obs["pixels"].astype(jnp.float32) * _LEVEL
        return {PIXELS: pixels} | {name: obs[name] for name in obs if name != "pixels"}

    @property
    def observation_size(self) -> int | dict[str, tuple[int, ...]]:
        """S with ``obs_mode="state"``, else the shapes of the dictionary's entries."""
        if self.env.obs_mode == "state":
            return self.env.physics.state_size
        shapes = jax.eval_shape(self.observation, self.env.obs_spec)
        return {name: shape.shape for name, shape in shapes.items()}

    @property
    def action_size(self) -> int:
        """Length A of an action, a (A,) float32 vector in [-1, 1]."""
        return self.env.action_size

    @property
    def backend(self) -> str:
        """Name of the physics backend."""
        return self.env.physics.backend

    @property
    def dt(self) -> float:
        """Seconds of simulated time per call of ``step``."""
        return self.env.dt

    def _fields(self, timestep: Timestep) -> dict[str, Any]:
        return {
            "obs": self.observation(timestep.obs),
            "reward": timestep.reward,
            "done": timestep.terminated.astype(jnp.float32),
            "metrics": {"non_finite": timestep.info["non_finite"].astype(jnp.float32)},
        }


def wrap_fresh_episodes(
    env: BraxEnv,
    episode_length: int = 1000,
    action_repeat: int = 1,
    randomization_fn: Any = None,
) -> Wrapper:
    """Wrap for training as Brax does, but start every episode from a sampled initial state.

    For ``wrap_env_fn`` of Brax's trainers. ``episode_length`` counts calls of ``step``, and
    ``action_repeat`` should be 1, see ``BraxEnv``. A reset costs time only when an episode ends.

    Raises:
        ValueError: ``randomization_fn`` is given.
        TypeError: ``env`` is already wrapped.
    """
    if not isinstance(env, BraxEnv):
        raise TypeError(f"env must be a bare BraxEnv, got {type(env).__name__}.")
    if randomization_fn is not None:
        raise ValueError(
            "wrap_fresh_episodes resets all episodes with the same EnvParams: leave out "
            "randomization_fn, or leave out wrap_env_fn."
        )
    return _FreshEpisodes(EpisodeWrapper(VmapWrapper(env), episode_length, action_repeat))


class _FreshEpisodes(Wrapper):
    """Resets to the next episode in the step that ends one, as ``AutoResetWrapper`` does."""

    def step(self, state: State, action: jax.Array) -> State:
        # Brax reads flag and step count after an episode's last step; the next may clear them.
        steps = jnp.where(state.done, 0.0, state.info["steps"])
        info = {**state.info, "steps": steps}
        state = self.env.step(state.replace(done=jnp.zeros_like(state.done), info=info), action)
        inner, num_envs = self.env.unwrapped, state.done.shape[0]
        vector = VectorPixelEnv(inner.env, num_envs)
        pipeline, timestep = vector.reset_where(state.pipeline_state, state.done > 0.5, inner.sys)
        return state.replace(pipeline_state=pipeline, obs=inner.observation(timestep.obs))


def _patch_trainers() -> None:
    # Imported here, because its trainers load slowly.
    with import_silenced():
        from brax.training import pmap
        from brax.training.agents.apg import train as apg
        from brax.training.agents.ppo import train as ppo
        from brax.training.agents.sac import train as sac
    for module in (pmap, apg, ppo, sac):
        accept_device_put_replicated(module)
