"""Off-policy algorithms: DrQ-v2."""
