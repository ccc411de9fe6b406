"""Run one case: ``python -m pixelbrax_gym.bench.worker MODULE.FUNCTION ARGUMENTS``."""

from __future__ import annotations

import importlib
import json
import os
import sys
from contextlib import suppress

# JAX and PyTorch take turns on the same cores.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def main() -> None:
    """Call the function with the arguments, given as JSON, and write its result as a JSON line."""
    module, _, function = sys.argv[1].rpartition(".")
    result = getattr(importlib.import_module(module), function)(**json.loads(sys.argv[2]))
    sys.stdout.write(json.dumps({"values": result, "peak_bytes": peak_bytes()}) + "\n")


def peak_bytes() -> dict[str, int | None]:
    """Return the peak memory of this process on host and device in bytes; None if unknown."""
    import jax

    device = jax.devices()[0].memory_stats() or {}
    host = None
    with suppress(ImportError):  # Windows
        import resource

        unit = 1 if sys.platform == "darwin" else 1024
        host = unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {"host": host, "device": device.get("peak_bytes_in_use")}


if __name__ == "__main__":
    main()
