"""What differs by device: decided when a program is lowered, and known to nothing else."""
