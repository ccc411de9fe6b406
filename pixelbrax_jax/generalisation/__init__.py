"""Suites of test levels: what changes in the image of a task, level by level."""
