"""Multipliers of a model's dynamics, for MuJoCo's models and those of MuJoCo XLA."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from pixelbrax_jax.physics.mujoco.opengl import mujoco

_MUSCLE = int(mujoco.mjtGain.mjGAIN_MUSCLE)
_KINDS = [int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE), _MUSCLE]
_DAMPING = (
    *("dof_damping", "dof_dampingpoly", "tendon_damping", "tendon_dampingpoly"),
    *("actuator_damping", "actuator_dampingpoly"),
)
_FORCE_OF_MUSCLES = [False, False, True, True] + 6 * [False]
_GAINS = 3 * [True] + 7 * [False]


def multiplied(model: Any, multipliers: Any) -> dict[str, Any]:
    """Return the fields that change, by name, for multipliers in the order of ``DynamicsRanges``.

    Friction is that of contacts. With a body's mass its inertia changes. The stiffness of
    constraints stays, that is ``body_invweight0`` and the like: a heavier body sinks deeper.
    """
    friction, mass, damping, gain, gravity = multipliers
    is_muscle = np.asarray(model.actuator_gaintype)[:, None] == _MUSCLE
    gains = np.where(is_muscle, _FORCE_OF_MUSCLES, _GAINS)
    gains = 1 + gains * (gain - 1)
    return {
        "geom_friction": model.geom_friction * friction,
        "pair_friction": model.pair_friction * friction,
        "body_mass": model.body_mass * mass,
        "body_inertia": model.body_inertia * mass,
        "body_subtreemass": model.body_subtreemass * mass,
        # MuJoCo reads the inertia of simple bodies from here.
        "dof_M0": (model.dof_M0 - model.dof_armature) * mass + model.dof_armature,
        # MuJoCo XLA's models have only some of these fields.
        **{name: getattr(model, name) * damping for name in _DAMPING if hasattr(model, name)},
        "actuator_gainprm": model.actuator_gainprm * gains,
        "actuator_biasprm": model.actuator_biasprm * gains,
        "opt.gravity": model.opt.gravity * gravity,
    }


def check_varies(model: mujoco.MjModel) -> None:
    """Raise a ValueError that names the actuators whose gain has no multiplier."""
    other = [
        repr(model.actuator(i).name or f"actuator/{i}")
        for i in np.flatnonzero(~np.isin(model.actuator_gaintype, _KINDS))
    ]
    if other:
        raise ValueError(
            f"dynamics cannot vary with actuator {', '.join(other)}: its gain must be fixed, "
            "affine or a muscle's."
        )


class MultipliedModels:
    """Copies of a model, one for each row of multipliers."""

    def __init__(self, model: mujoco.MjModel):
        self._model = model
        self._copies: list[mujoco.MjModel] = []
        self._multipliers = np.empty((0, 0))

    def of_rows(self, multipliers: np.ndarray) -> list[mujoco.MjModel]:
        """Return models for (N, 5) multipliers; a row as in the last call costs nothing."""
        before, self._multipliers = self._multipliers, np.empty((0, 0))
        for i, row in enumerate(multipliers):
            if i == len(self._copies):
                self._copies.append(copy.copy(self._model))
            elif i < len(before) and (before[i] == row).all():
                continue
            for name, value in multiplied(self._model, row.astype(float)).items():
                owner = self._copies[i].opt if name == "opt.gravity" else self._copies[i]
                getattr(owner, name.removeprefix("opt."))[:] = value
        self._multipliers = multipliers.copy()
        return self._copies[: len(multipliers)]
