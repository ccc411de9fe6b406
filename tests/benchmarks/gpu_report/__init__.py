"""The report of a run on an NVIDIA GPU: ``python -m tests.benchmarks.gpu_report``."""
