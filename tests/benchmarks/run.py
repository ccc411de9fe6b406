"""Measures all that ``pixelbrax bench --full`` does, and more.

python -m tests.benchmarks.run                      all but peers; hours
python -m tests.benchmarks.run --only startup       one part; minutes
python -m tests.benchmarks.run --only peers         others beside us, installed on first use
python -m tests.benchmarks.run --only dmc           every task of the DM Control Suite; half an hour
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from pixelbrax_gym.bench.cases import TASKS
from pixelbrax_gym.bench.command import add_options, run
from pixelbrax_jax.tasks import DMC_TASKS
from tests.benchmarks.cases import GROUPS


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the benchmark.

    Args:
        arguments: of the command line; None means those of this process.

    Returns:
        The exit status: 1 if a case failed for another reason than memory or something absent.
    """
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.run",
        description=__doc__,
        formatter_class=argparse.RawTextHelpFormatter,
    )
    add_options(parser, list(GROUPS), "runs/benchmarks", (*TASKS, *DMC_TASKS))
    parser.add_argument("--peers", action="store_true", help="measure peers too")
    options = parser.parse_args(arguments)
    # The two need what is not installed with the tests: OpenGL, and other simulators.
    names = [name for name in GROUPS if name not in ("peers", "dmc") or options.peers]
    return run(parser.prog, options, GROUPS, options.only or names)


if __name__ == "__main__":
    sys.exit(main())
