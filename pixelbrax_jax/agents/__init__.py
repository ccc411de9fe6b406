"""Agents in JAX that learn from pixels: PPO, PPG, DCPG and DrQ-v2."""

from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.off_policy.config import DrQv2Config
from pixelbrax_jax.agents.off_policy.drqv2 import DrQv2
from pixelbrax_jax.agents.on_policy.dcpg import DCPG, DCPGConfig
from pixelbrax_jax.agents.on_policy.ppg import PPG, PPGConfig
from pixelbrax_jax.agents.on_policy.ppo import PPO, PPOConfig
from pixelbrax_jax.agents.presets import preset
from pixelbrax_jax.agents.registry import ALGORITHMS, make_algorithm, make_train

__all__ = [
    "ALGORITHMS",
    "DCPG",
    "PPG",
    "PPO",
    "Algorithm",
    "DCPGConfig",
    "DrQv2",
    "DrQv2Config",
    "PPGConfig",
    "PPOConfig",
    "make_algorithm",
    "make_train",
    "preset",
]
