"""Initial states, observations and rewards of the DM Control Suite's tasks."""

from __future__ import annotations

from pixelbrax_jax.physics.dmc.domains import hands, poles, targets, walkers

FORMULAS = poles.TASKS | walkers.TASKS | targets.TASKS | hands.TASKS
"""Formulas by the name of the task."""
