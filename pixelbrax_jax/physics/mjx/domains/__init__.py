"""Domains of the DM Control Suite: initial states, observations and rewards of their tasks."""
