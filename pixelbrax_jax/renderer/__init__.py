"""Scene -> frame."""
