"""TorchRL: many environments in one program."""
