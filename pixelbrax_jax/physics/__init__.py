"""Dynamics: what moves, what it earns, when it ends. One folder for each suite of tasks.

Nothing is loaded here, so that a suite's table of tasks can be read without JAX or MuJoCo.
"""
