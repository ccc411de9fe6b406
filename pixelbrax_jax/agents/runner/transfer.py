"""Play a policy in another simulator of its task, from the same initial states."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from pixelbrax_jax.agents.runner.evaluate import Result
from pixelbrax_jax.agents.runner.progress import Report, silent
from pixelbrax_jax.agents.runner.trained import Player
from pixelbrax_jax.agents.train_state import Networks
from pixelbrax_jax.compilation import jit
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.flags import default_flags
from pixelbrax_jax.generalisation.suites import EPISODES
from pixelbrax_jax.types import EnvParams


def play_in(
    simulator: Any,
    player: Player,
    networks: Networks,
    env: PixelEnv,
    params: EnvParams,
    *,
    num_episodes: int = 32,
    physics: bool = True,
    picture: bool = True,
    report: Report = silent,
) -> Result:
    """Play the episodes of an ``Evaluator`` in another simulator, with mean actions.

    ``simulator`` is like ``physics.dmc.suite.SuiteEnv``, for one environment. The episodes have the
    same initial states, time limit, action repeat and frame stack. With ``physics`` false the
    simulator shows every state of our physics instead of computing its own; with ``picture`` false
    we show every state of its physics. ``env`` has neither distractors nor ``obs_mode="both"``;
    with ``"state"`` the policy sees the simulator's observation.
    """
    acting = {name: networks[name] for name in player.acting}
    bare = replace(env, obs_mode="state")
    with default_flags():
        keys = VectorPixelEnv.env_keys(jax.random.key(EPISODES), num_episodes)
    returns, lengths = np.zeros(num_episodes), np.zeros(num_episodes, int)

    def look(frames: deque[np.ndarray], key: jax.Array) -> np.ndarray:
        if env.obs_mode == "state":
            return simulator.observe()
        if picture:
            image = simulator.render()
        else:
            image = np.asarray(_draw(env, simulator.qpos, simulator.qvel, key, params))
        frames.extend([image] * (1 if frames else env.frame_stack))
        return np.concatenate(frames, axis=-1)

    for episode, key in enumerate(keys):
        frames: deque[np.ndarray] = deque(maxlen=env.frame_stack)
        state, _ = _reset(bare, key, params)
        simulator.start(state.sim.physics)
        over = False
        while not over:
            action = np.asarray(_act(player, acting, look(frames, key)[None]))[0]
            if physics:
                left = int(params.episode_length) - lengths[episode]
                repeats = min(env.action_repeat, left)
                returns[episode] += sum(simulator.step(action) for _ in range(repeats))
                lengths[episode] += repeats
                over = repeats == left
            else:
                state, timestep = _step(bare, state, action, params)
                simulator.start(state.sim.physics)
                returns[episode] = timestep.info["episode_return"]
                lengths[episode] = timestep.info["episode_length"]
                over = bool(state.done)
        report(f"episode {episode + 1} of {num_episodes}: return {returns[episode]:.1f}")
    return Result(returns=returns, lengths=lengths)


@jit(static_argnums=0)
def _act(player: Player, networks: Networks, obs: Any) -> jax.Array:
    return player.act(networks, obs)


_reset, _step = (jit(static_argnums=0)(method) for method in (PixelEnv.reset, PixelEnv.step))


@jit(static_argnums=0)
def _draw(env: PixelEnv, qpos: Any, qvel: Any, key: jax.Array, params: EnvParams) -> jax.Array:
    """Draw our picture of a pose, with the target of the episode of ``key``."""
    state, _ = replace(env, obs_mode="state").from_qpos(qpos, qvel, key, params)
    return env.image(state, params)
