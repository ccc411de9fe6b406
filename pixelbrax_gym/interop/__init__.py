"""Arrays that cross between JAX, NumPy and torch, and processes that fork."""
