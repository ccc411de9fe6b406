"""Adapt PixelBrax to Stable-Baselines3."""
