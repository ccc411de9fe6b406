"""An environment for each peer, made when it is first needed."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path

from pixelbrax_gym.bench.case import AbsentError

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
    """The Python that has the peer; what cannot be installed is tried once.

    Args:
        peer: a key of ``PEERS``.

    Returns:
        The path of the interpreter.

    Raises:
        AbsentError: the peer cannot be installed.
    """
    found = _install(peer)
    if isinstance(found, AbsentError):
        raise found
    return found


@cache
def _install(peer: str) -> str | AbsentError:
    home = HOME / peer
    python = home / "bin" / "python"
    mark = home / ".installed"
    wanted = "\n".join(PEERS[peer])
    if mark.exists() and mark.read_text() == wanted:
        return str(python)
    print(f"Installing {peer} into {home} ...", flush=True)
    try:
        subprocess.run([sys.executable, "-m", "venv", str(home)], check=True, capture_output=True)
        subprocess.run(
            [str(python), "-m", "pip", "install", "--quiet", *PEERS[peer]],
            check=True,
            capture_output=True,
            text=True,
        )
    except (OSError, subprocess.CalledProcessError) as error:
        lines = str(getattr(error, "stderr", "") or error).strip().splitlines()
        return AbsentError(f"cannot be installed: {lines[-1] if lines else error}")
    mark.write_text(wanted)
    return str(python)
