"""MuJoCo XLA: the engine that simulates the DM Control Suite."""
