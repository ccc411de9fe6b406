"""Measure the speed of PixelBrax on the user's machine."""
