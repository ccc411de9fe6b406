"""Images of every task, look and camera as they were last accepted."""
