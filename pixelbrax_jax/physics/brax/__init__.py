"""Brax's tasks and backends, and tasks from MJCF files."""
