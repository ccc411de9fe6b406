"""Check whether JAX and PyTorch work together here, and how to fix what does not."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

from pixelbrax_gym import doctor
from pixelbrax_gym.cli import parse


@dataclass(frozen=True)
class Options:
    """Tells whether JAX and PyTorch see the same device and share frames, and how to fix it if not.

    Exits with 1 if there is a problem.
    """


def run(arguments: Sequence[str]) -> int:
    """Run the command."""
    parse("doctor", Options, arguments)
    findings = doctor.diagnose(doctor.inspect())
    sys.stdout.write(doctor.report(findings) + "\n")
    return int(any(finding.level == "problem" for finding in findings))
