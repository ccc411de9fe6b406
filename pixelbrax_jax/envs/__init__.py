"""Pixel environments and batches of them."""
