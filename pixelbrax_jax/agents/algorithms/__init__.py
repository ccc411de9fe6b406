"""One file for each algorithm, and the named settings of all."""
