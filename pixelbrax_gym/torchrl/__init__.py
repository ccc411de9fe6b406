"""Adapt PixelBrax to TorchRL."""
