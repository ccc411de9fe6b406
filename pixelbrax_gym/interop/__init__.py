"""Exchange arrays between JAX, NumPy and torch, and detect forked processes."""
