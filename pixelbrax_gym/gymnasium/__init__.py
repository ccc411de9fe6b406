"""Gymnasium: one environment, and many in one program."""
