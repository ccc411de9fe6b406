"""Features of a model that MuJoCo XLA silently ignores and MuJoCo does not."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from pixelbrax_jax.physics.mujoco.opengl import mujoco

_MOST_NAMES = 5


def check_simulated(model: mujoco.MjModel) -> None:
    """Raise a ValueError that names all that MuJoCo XLA ignores of a compiled model."""
    found = []
    for feature, kind, where in _features(model):
        has = np.asarray(where) != 0
        having = np.flatnonzero(has.any(axis=tuple(range(1, has.ndim))))
        if len(having):
            names = [repr(getattr(model, kind)(i).name or f"{kind}/{i}") for i in having]
            more = len(names) - _MOST_NAMES
            some = ", ".join(names[:_MOST_NAMES]) + (f" and {more} more" if more > 0 else "")
            found.append(f"{feature} ({kind} {some})")
    bits = mujoco.mjtDisableBit
    for name, bit in (("spring", bits.mjDSBL_SPRING), ("damper", bits.mjDSBL_DAMPER)):
        if model.opt.disableflags & int(bit):
            found.append(f"flag {name}='disable'")
    if found:
        raise ValueError(
            f"MuJoCo XLA does not simulate {'; '.join(found)}: compute on a CPU, with "
            "engine='mujoco', or remove it from the model."
        )


def _features(model: mujoco.MjModel) -> Iterator[tuple[str, str, Any]]:
    """Yield features, kinds of elements, and numbers for each element, 0 without the feature."""

    def joints(of_dofs: np.ndarray) -> np.ndarray:
        return np.isin(np.arange(model.njnt), model.dof_jntid[of_dofs.any(axis=1)])

    yield "polynomial damping", "joint", joints(model.dof_dampingpoly)
    yield "polynomial stiffness", "joint", model.jnt_stiffnesspoly
    yield "polynomial damping", "tendon", model.tendon_dampingpoly
    yield "polynomial stiffness", "tendon", model.tendon_stiffnesspoly
    yield "armature", "actuator", model.actuator_armature
    yield "damping", "actuator", model.actuator_damping
    yield "polynomial damping", "actuator", model.actuator_dampingpoly
    disabled = [group for group in range(31) if model.opt.disableactuator >> group & 1]
    off = np.isin(model.actuator_group, disabled)
    yield "option actuatorgroupdisable", "actuator", off
    yield "ellipsoid fluid forces", "geom", model.geom_fluid
    yield "surface velocity", "geom", model.geom_surfacevel
