"""Training runs: checkpoints, evaluation, videos and metrics."""
