"""How a CPU runs the physics of a batch fast; nothing else knows of it."""
