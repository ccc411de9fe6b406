"""The NVIDIA GPU of this machine, and what stands in the way of a report, without starting JAX."""

from __future__ import annotations

import csv
import os
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec

REHEARSAL = "--rehearse does the same on the CPU at a small size."

KERNEL_CAPABILITY = 8.0
"""Least compute capability of the kernel; see ``pixelbrax_jax.renderer.choice``."""

OLDEST_DRIVERS = {12: 525, 13: 580}
"""CUDA release -> the oldest NVIDIA driver that runs it."""

LEAST_GB = 2.0
"""Free memory in which the smallest cases run."""

_FIELDS = ("name", "driver_version", "memory.total", "memory.free", "compute_cap", "compute_mode")


class CardError(Exception):
    """There is no GPU that a report can be made of; the message says what to do."""


@dataclass(frozen=True)
class Card:
    """What ``nvidia-smi`` says of a GPU; memory in GB of 2^30 bytes."""

    name: str
    driver: str
    total_gb: float
    free_gb: float
    capability: float
    mode: str

    @property
    def has_kernel(self) -> bool:
        """Whether the card can run the renderer's kernel."""
        return self.capability >= KERNEL_CAPABILITY

    @property
    def exclusive(self) -> bool:
        """Whether the card serves one process at a time."""
        return "exclusive" in self.mode.lower()


def read_card(environ: Mapping[str, str]) -> Card:
    """Ask ``nvidia-smi`` for the first GPU that programs see.

    Raises:
        CardError: there is none.
    """
    visible = environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None and visible.split(",")[0].strip() in ("", "-1", "NoDevFiles"):
        raise CardError(
            f"CUDA_VISIBLE_DEVICES={visible!r} hides every GPU: unset it, or name one as in "
            f"CUDA_VISIBLE_DEVICES=0. {REHEARSAL}"
        )
    query = ["nvidia-smi", f"--query-gpu={','.join(_FIELDS)}", "--format=csv,noheader,nounits"]
    # nvidia-smi knows no slices of a card.
    if visible and not visible.startswith("MIG"):
        query += ["-i", visible.split(",")[0].strip()]
    try:
        done = subprocess.run(query, capture_output=True, text=True, timeout=60, check=False)
    except FileNotFoundError:
        raise CardError(
            f"there is no NVIDIA GPU here: the program nvidia-smi is missing. {REHEARSAL}"
        ) from None
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CardError(f"nvidia-smi does not answer: {error}. {REHEARSAL}") from None
    lines = done.stdout.strip().splitlines()
    if done.returncode or not lines:
        told = (done.stdout + done.stderr).strip() or f"exit status {done.returncode}"
        raise CardError(f"nvidia-smi shows no GPU: {told.splitlines()[-1]}. {REHEARSAL}")
    return parse_card(lines[0])


def parse_card(line: str) -> Card:
    """Return the card of a line of ``nvidia-smi``'s CSV; what it does not know becomes 0."""
    name, driver, total, free, capability, mode = map(str.strip, next(csv.reader([line])))

    def number(text: str) -> float:
        return float(text) if text.replace(".", "", 1).isdigit() else 0.0

    # Cards that share the host's memory have none of their own to tell.
    total_gb, free_gb = (number(text) / 1024 or float("inf") for text in (total, free))
    return Card(name, driver, total_gb, free_gb, number(capability), mode)


def installed_cuda() -> list[int]:
    """Return the CUDA releases that JAX is installed for."""
    return [release for release in OLDEST_DRIVERS if find_spec(f"jax_cuda{release}_plugin")]


def check_card(card: Card, cuda: list[int], environ: Mapping[str, str]) -> list[str]:
    """Return notes on what a report of this card leaves out.

    Raises:
        CardError: JAX cannot compute on it.
    """
    if os.name != "posix":
        raise CardError("JAX computes on NVIDIA GPUs only under Linux. " + REHEARSAL)
    platforms = environ.get("JAX_PLATFORMS", "")
    if platforms and not {"cuda", "gpu"} & set(platforms.split(",")):
        raise CardError(
            f"JAX_PLATFORMS={platforms!r} hides the {card.name} from JAX: unset it. {REHEARSAL}"
        )
    driver = int(card.driver.split(".")[0]) if card.driver[:1].isdigit() else 0
    fits = [release for release in OLDEST_DRIVERS if driver >= OLDEST_DRIVERS[release]]
    if driver and not fits:
        raise CardError(
            f"the driver {card.driver} of the {card.name} is too old: JAX needs "
            f"{OLDEST_DRIVERS[12]} or newer for CUDA 12. {REHEARSAL}"
        )
    newest = f"cuda{max(fits or OLDEST_DRIVERS)}"
    if not cuda:
        raise CardError(
            f"JAX is installed without CUDA: `make gpu-report CUDA={newest}` installs it, as does "
            f'`pip install "jax[{newest}]"`. {REHEARSAL}'
        )
    if driver and not set(cuda) & set(fits):
        wrong = cuda[0]
        raise CardError(
            f"JAX is installed for CUDA {wrong}, which needs a driver of {OLDEST_DRIVERS[wrong]} "
            f"or newer; the {card.name} has {card.driver}. Uninstall jax-cuda{wrong}-plugin and "
            f"jax-cuda{wrong}-pjrt, then `make gpu-report CUDA={newest}`. {REHEARSAL}"
        )
    if card.mode.lower() == "prohibited":
        raise CardError(
            f"the {card.name} lets no program compute (compute mode {card.mode}): "
            f"`nvidia-smi -c DEFAULT` as administrator. {REHEARSAL}"
        )
    if card.free_gb < LEAST_GB:
        raise CardError(
            f"{card.free_gb:.1f} GB of {card.total_gb:.1f} GB are free on the {card.name}, and the "
            f"smallest cases need {LEAST_GB:.0f} GB: end the programs that nvidia-smi lists. "
            f"{REHEARSAL}"
        )
    notes = []
    if not card.has_kernel:
        notes.append(
            f"the {card.name} has compute capability {card.capability}, and the kernel needs "
            f"{KERNEL_CAPABILITY}: the plain ray-caster draws, and the checks of the kernel are "
            "left out."
        )
    return notes
