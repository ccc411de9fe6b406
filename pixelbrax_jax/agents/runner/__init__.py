"""What runs an algorithm: training, checkpoints, evaluation, videos, metrics."""
