"""The DM Control Suite: its models, and formulas of its tasks."""
