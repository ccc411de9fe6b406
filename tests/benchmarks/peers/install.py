"""An environment for each peer, made when it is first needed."""

from __future__ import annotations

import sys
from pathlib import Path

from tests.benchmarks.packages import install_packages

HOME = Path(__file__).parents[3] / ".venv-peers"

PEERS: dict[str, tuple[str, ...]] = {
    "dm_control": (
        "dm_control==1.0.50",
        "mujoco==3.17.0",
        "gymnasium==1.4.0",
        "stable-baselines3==2.9.2",
        "torch==2.13.0",
    ),
    "mujoco_warp": ("mujoco-warp==4.0.0", "warp-lang==1.19.0", "mujoco==4.0.0"),
    "gymnasium": ("gymnasium[mujoco]==1.4.0", "mujoco==3.17.0", "pyopengl"),
    "envpool": ("envpool==1.2.5",),
}
"""Peer -> what is installed for it, into an environment of its own."""


def peer_python(peer: str) -> str:
    """The Python that has the peer."""
    home, wanted = HOME / peer, PEERS[peer]
    python = str(home / "bin" / "python")
    make = (sys.executable, "-m", "venv", str(home))
    install_packages(home, wanted, make, (python, "-m", "pip", "install", "--quiet", *wanted))
    return python
