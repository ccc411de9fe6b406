"""Scenes: geoms in the world frame, a camera and a look."""
