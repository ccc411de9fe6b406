"""The command ``pixelbrax``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command.

    Args:
        arguments: of the command line; None means those of this process.

    Returns:
        The exit status, 0 when all is well.
    """
    parser = argparse.ArgumentParser(
        prog="pixelbrax", description="Continuous control from pixels, on JAX."
    )
    parser.add_argument("--version", action="version", version=_version())
    commands = parser.add_subparsers(title="commands", required=True)
    command = commands.add_parser(
        "doctor",
        help="tell whether JAX and PyTorch work together here, and cure what does not",
        description="Tells whether JAX and PyTorch see the same device, whether frames cross "
        "between them without a copy, and how to cure what is amiss. Exits with 1 if something "
        "is.",
    )
    command.set_defaults(run=_doctor)
    options = parser.parse_args(arguments)
    return int(options.run())


def _version() -> str:
    try:
        return version("pixelbrax")
    except PackageNotFoundError:
        return "not installed"


def _doctor() -> int:
    from pixelbrax_gym import doctor

    findings = doctor.diagnose(doctor.inspect())
    sys.stdout.write(doctor.report(findings) + "\n")
    return int(any(finding.level == "trouble" for finding in findings))


if __name__ == "__main__":
    sys.exit(main())
