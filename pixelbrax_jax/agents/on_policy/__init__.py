"""Algorithms that learn from what their current policy does: PPO, PPG and DCPG."""
