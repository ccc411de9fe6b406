"""One case in this process: ``python -m pixelbrax_gym.bench.worker MODULE.FUNCTION ARGUMENTS``.

The result is the last line of the output, as JSON.
"""

from __future__ import annotations

import importlib
import json
import os
import sys

# JAX and PyTorch take turns on the same cores.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def main() -> None:
    """Measure, and write what was found."""
    module, _, function = sys.argv[1].rpartition(".")
    result = getattr(importlib.import_module(module), function)(**json.loads(sys.argv[2]))
    sys.stdout.write(json.dumps({"values": result, "peak_bytes": peak_bytes()}) + "\n")


def peak_bytes() -> dict[str, int | None]:
    """Most memory that this process has held, on the host and on its device; None if unknown."""
    import jax

    device = jax.devices()[0].memory_stats() or {}
    return {"host": _host_bytes(), "device": device.get("peak_bytes_in_use")}


def _host_bytes() -> int | None:
    try:
        import resource
    except ImportError:  # Windows
        return None
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return used if sys.platform == "darwin" else 1024 * used


if __name__ == "__main__":
    main()
