"""Agents that learn from pixels, written in JAX: PPO, PPG and DCPG."""

from pixelbrax_jax.agents.algorithms.dcpg import DCPG, DCPGConfig
from pixelbrax_jax.agents.algorithms.ppg import PPG, PPGConfig
from pixelbrax_jax.agents.algorithms.ppo import PPO, PPOConfig
from pixelbrax_jax.agents.algorithms.presets import preset
from pixelbrax_jax.agents.algorithms.registry import ALGORITHMS, make_algorithm, make_train
from pixelbrax_jax.agents.core.algorithm import Algorithm

__all__ = [
    "ALGORITHMS",
    "DCPG",
    "PPG",
    "PPO",
    "Algorithm",
    "DCPGConfig",
    "PPGConfig",
    "PPOConfig",
    "make_algorithm",
    "make_train",
    "preset",
]
