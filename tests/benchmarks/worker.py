"""One case in this process: ``python -m tests.benchmarks.worker MODULE.FUNCTION ARGUMENTS``.

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
    module, function = sys.argv[1].split(".")
    arguments = json.loads(sys.argv[2])
    result = getattr(importlib.import_module(f"tests.benchmarks.{module}"), function)(**arguments)
    print(json.dumps({"values": result, "peak_bytes": peak_bytes()}))


def peak_bytes() -> dict[str, int | None]:
    """Most memory that this process has held, on the host and on its device."""
    import resource

    import jax

    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    device = jax.devices()[0].memory_stats() or {}
    return {
        "host": used if sys.platform == "darwin" else 1024 * used,
        "device": device.get("peak_bytes_in_use"),
    }


if __name__ == "__main__":
    main()
