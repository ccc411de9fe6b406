"""List the tasks."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec

from pixelbrax_gym.cli import parse, say
from pixelbrax_jax.tasks import TASKS


@dataclass(frozen=True)
class Options:
    """Lists the tasks."""


def run(arguments: Sequence[str]) -> int:
    """Run the command."""
    parse("tasks", Options, arguments)
    width = max(map(len, TASKS))
    for name, row in TASKS.items():
        sys.stdout.write(f"{name:{width}}  {row.gymnasium_id}: {row.summary}\n")
    if find_spec("dm_control") is None:
        from pixelbrax_jax.physics.dmc.models import how_to_install

        say("tasks", f"tasks named dmc need dm_control: {how_to_install()}")
    return 0
