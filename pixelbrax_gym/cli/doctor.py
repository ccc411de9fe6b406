"""Check that JAX and PyTorch work together on this machine."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

from pixelbrax_gym import doctor
from pixelbrax_gym.cli import parse


@dataclass(frozen=True)
class Options:
    """Checks that JAX and PyTorch see the same device and share frames; prints a fix if not.

    Exits with 1 if it finds a problem.
    """


def run(arguments: Sequence[str]) -> int:
    """Run the command."""
    parse("doctor", Options, arguments)
    findings = doctor.diagnose(doctor.inspect())
    sys.stdout.write(doctor.report(findings) + "\n")
    return int(any(finding.level == "problem" for finding in findings))
