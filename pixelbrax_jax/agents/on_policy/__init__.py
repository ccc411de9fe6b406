"""On-policy algorithms: PPO, PPG and DCPG."""
