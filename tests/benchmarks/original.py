"""Speeds of the original, the code of arXiv 2502.00021."""

from __future__ import annotations

ORIGINAL = (
    ("halfcheetah", 4, 12.6),
    ("halfcheetah", 32, 8.7),
    ("ant", 4, 4.3),
    ("humanoid", 4, 4.4),
    ("walker2d", 4, 13.5),
)
"""Task, environments and steps per second of the original (the code of arXiv 2502.00021)
on two cores of an AMD EPYC machine whose vectors were not noted; measured once, apart."""
