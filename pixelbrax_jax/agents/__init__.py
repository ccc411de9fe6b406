"""Agents that learn from pixels, written in JAX: PPO, PPG and DCPG."""
