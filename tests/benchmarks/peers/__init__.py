"""Other simulators that draw pictures, each measured in an environment of its own."""
