"""Programs compiled ahead of time for accelerators that this machine need not have."""
