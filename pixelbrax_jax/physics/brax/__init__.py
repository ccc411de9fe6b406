"""Brax's tasks and backends, and tasks made of an MJCF file."""
