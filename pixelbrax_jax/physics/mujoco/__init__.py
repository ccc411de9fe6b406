"""Tasks of MuJoCo models, stepped by MuJoCo itself, MuJoCo XLA or MuJoCo Warp."""
