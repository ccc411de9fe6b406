"""Other simulators that draw images, each measured in an environment of its own."""
