"""Poses -> scene: geoms in the world, a camera, and how it all looks."""
