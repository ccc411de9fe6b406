"""Stable-Baselines3: many environments in one program."""
