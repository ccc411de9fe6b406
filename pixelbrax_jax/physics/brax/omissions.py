"""Features of a MuJoCo model that Brax's backends silently ignore.

The list has what changes how ``mujoco.mj_step`` moves a model. It leaves out what hardly matters
(see docs/howto/own-task.md) and what ``mujoco.mjx.put_model`` rejects itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from pixelbrax_jax.physics.mujoco_compatibility import import_silenced
from pixelbrax_jax.physics.opengl import mujoco

with import_silenced():
    from mujoco.mjx._src.collision_driver import geom_pairs

_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_BALL = int(mujoco.mjtJoint.mjJNT_BALL)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)

_BRAX_NUMERICS = {
    "constraint_stiffness",
    "constraint_limit_stiffness",
    "constraint_ang_damping",
    "constraint_vel_damping",
}
"""Stand for stiffness and damping in models written for Brax's backends."""

_MOST_NAMES = 5


class Omission(NamedTuple):
    """A feature that a backend does not simulate, with the elements that have it."""

    feature: str
    in_mjx: bool


def check_simulated(model: mujoco.MjModel, backend: str) -> None:
    """Raise an error that lists all features of a compiled model that a backend ignores.

    Raises:
        ValueError: the list is not empty; the message has the fix.
    """
    missing = omissions(model, backend)
    if not missing:
        return
    lost = [row.feature for row in missing if row.in_mjx]
    fix = "" if len(lost) == len(missing) else "use backend='mjx'"
    if lost:
        fix += (", and " if fix else "") + (
            f"remove {', '.join(lost) if fix else 'it'} from the model, which no backend simulates"
        )
    raise ValueError(
        f"the {backend!r} backend does not simulate {'; '.join(row.feature for row in missing)}: "
        f"{fix}."
    )


def omissions(model: mujoco.MjModel, backend: str) -> list[Omission]:
    """Return the features of a compiled model that a backend ignores."""
    found = [Omission(feature, True) for feature in _in_all(model)]
    if backend != "mjx":
        found += [Omission(feature, False) for feature in _in_brax(model)]
    if backend in ("positional", "spring"):
        found += [Omission(feature, False) for feature in _in_maximal(model)]
    return found


def _in_all(model: mujoco.MjModel) -> Iterator[str]:
    """Yield features that MuJoCo XLA ignores, and therefore Brax."""
    yield from _of(model, "polynomial damping", "joint", _joints(model, model.dof_dampingpoly))
    yield from _of(model, "polynomial stiffness", "joint", model.jnt_stiffnesspoly)
    yield from _of(model, "armature", "actuator", model.actuator_armature)
    damping = np.column_stack([model.actuator_damping, model.actuator_dampingpoly])
    yield from _of(model, "damping", "actuator", damping)
    yield from _of(model, "delay", "actuator", model.actuator_delay)
    off = [bool(model.opt.disableactuator >> int(group) & 1) for group in model.actuator_group]
    yield from _of(model, "option actuatorgroupdisable", "actuator", np.array(off, bool))
    yield from _of(model, "ellipsoid fluid forces", "geom", model.geom_fluid)
    yield from _of(model, "surface velocity", "geom", model.geom_surfacevel)
    for kind in ("body", "actuator", "geom"):
        yield from _of(model, "plugin", kind, getattr(model, f"{kind}_plugin") >= 0)
    yield from _flags(model, "spring", "damper")


def _in_brax(model: mujoco.MjModel) -> Iterator[str]:
    """Yield features that each of Brax's own backends ignores."""
    options = model.opt
    kind, free = model.jnt_type, model.jnt_type == _FREE
    yield from _of(model, "equality constraints", "equality", np.ones(model.neq, bool))
    yield from _of(model, "tendons", "tendon", np.ones(model.ntendon, bool))
    jointless = model.body_jntnum == 0
    jointless[0] = False
    yield from _of(model, "bodies without a joint", "body", jointless)
    yield from _of(model, "more than three joints", "body", model.body_jntnum > 3)
    yield from _of(model, "gravity compensation", "body", model.body_gravcomp)
    yield from _of(model, "ball joints", "joint", kind == _BALL)
    yield from _of(model, "frictionloss", "joint", _joints(model, model.dof_frictionloss))
    scalar, at = ~(free | (kind == _BALL)), model.jnt_qposadr
    yield from _of(model, "ref", "joint", scalar & (model.qpos0[at] != 0))
    sprung = model.jnt_stiffness != 0
    moved = model.qpos_spring[at] != model.qpos0[at]
    yield from _of(model, "springref", "joint", scalar & sprung & moved)
    yield from _of(model, "stiffness of free joints", "joint", free & sprung)
    yield from _of(model, "actuatorfrcrange", "joint", model.jnt_actfrclimited)
    first = model.body_jntadr[model.jnt_bodyid]
    apart = (model.jnt_pos != model.jnt_pos[first]).any(axis=1)
    yield from _of(model, "joints of a body at different places", "joint", apart)
    yield from _of_actuators(model)
    yield from _of_contacts(model)
    yield from _flags(model, "constraint", "gravity", "actuation")
    if model.jnt_limited.any():
        yield from _flags(model, "limit")
    if model.actuator_ctrllimited.any():
        yield from _flags(model, "clampctrl")
    if options.integrator != int(mujoco.mjtIntegrator.mjINT_EULER):
        yield f"option integrator={_label(mujoco.mjtIntegrator, options.integrator)}"
    if options.cone != int(mujoco.mjtCone.mjCONE_PYRAMIDAL):
        yield "option cone='elliptic'"
    if options.impratio != 1:
        yield f"option impratio={options.impratio:g}"
    if options.wind.any():
        yield "option wind"


def _of_actuators(model: mujoco.MjModel) -> Iterator[str]:
    on_joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    yield from _of(model, "transmission to other than joints", "actuator", ~on_joint)
    on_free = _on_free_joint(model)
    fixed = model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED)
    unbiased = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_NONE)
    affine = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
    stateful = model.actuator_dyntype != int(mujoco.mjtDyn.mjDYN_NONE)
    yield from _of(model, "activation dynamics", "actuator", stateful)
    yield from _of(model, "gain types other than fixed", "actuator", ~fixed)
    yield from _of(model, "bias types other than none and affine", "actuator", ~(unbiased | affine))
    constant = affine & (model.actuator_biasprm[:, 0] != 0)
    yield from _of(model, "constant bias", "actuator", constant)
    other_axes = (model.actuator_gear[:, 1:] != 0).any(axis=1)
    yield from _of(
        model,
        "gear beyond the first axis of a free joint, or feedback on it",
        "actuator",
        on_free & (other_axes | ~unbiased),
    )


def _of_contacts(model: mujoco.MjModel) -> Iterator[str]:
    dims: dict[int, list[str]] = {}
    slanted = []
    solid = np.zeros(model.ngeom, bool)
    for a, b, pair in geom_pairs(model):
        solid[[a, b]] = True
        if pair >= 0:
            dim, friction = int(model.pair_dim[pair]), model.pair_friction[pair, :2]
        else:
            dim, friction = int(model.geom_condim[[a, b]].max()), np.zeros(2)
        pair_name = f"{_name(model, 'geom', a)} and {_name(model, 'geom', b)}"
        dims.setdefault(dim, []).append(pair_name)
        if friction[0] != friction[1]:
            slanted.append(pair_name)
    for dim in sorted(set(dims) - {3}):
        yield f"condim {dim} (geoms {_some(dims[dim])})"
    if slanted:
        yield f"friction that differs by direction (geoms {_some(slanted)})"
    round_ones = (model.geom_type == _CYLINDER) & (model.geom_size[:, 1] > 0.001)
    yield from _of(model, "contacts of cylinders", "geom", solid & round_ones)
    for name, default in (("priority", 0), ("solmix", 1)):
        values = getattr(model, f"geom_{name}")
        yield from _of(model, name, "geom", (values != default) & (values != values[:1]).any())


def _in_maximal(model: mujoco.MjModel) -> Iterator[str]:
    """Yield features that only the backends with springs or corrections for joints ignore."""
    numerics = {model.numeric(i).name for i in range(model.nnumeric)}
    if not numerics & _BRAX_NUMERICS:
        yield from _of(model, "damping", "joint", _joints(model, model.dof_damping))
        yield from _of(model, "armature", "joint", _joints(model, model.dof_armature))
        yield from _of(model, "stiffness", "joint", model.jnt_stiffness)
    yield from _of(model, "forces on a free joint", "actuator", _on_free_joint(model))
    hinge = model.jnt_type == _HINGE
    wide = hinge & (model.jnt_limited == 1) & (np.abs(model.jnt_range) > np.pi).any(axis=1)
    yield from _of(model, "limits beyond half a turn", "joint", wide)
    bent = np.zeros(model.nbody, bool)
    for body in range(model.nbody):
        rows = slice(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
        kinds, axes = model.jnt_type[rows].tolist(), model.jnt_axis[rows]
        for chosen in (_HINGE, _SLIDE):
            same = axes[[kind == chosen for kind in kinds]]
            bent[body] |= not np.allclose(same @ same.T, np.eye(len(same)), atol=1e-4)
        mixed = _HINGE in kinds and _SLIDE in kinds
        bent[body] |= mixed and (kinds != sorted(kinds) or kinds.count(_HINGE) > 1)
    yield from _of(
        model, "joints of a body other than slides, then one hinge, at right angles", "body", bent
    )


def _on_free_joint(model: mujoco.MjModel) -> np.ndarray:
    """Return (actuators,) bool, whether an actuator acts on a free joint."""
    chosen = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    chosen[chosen] = model.jnt_type[model.actuator_trnid[chosen, 0]] == _FREE
    return chosen


def _joints(model: mujoco.MjModel, of_dofs: np.ndarray) -> np.ndarray:
    """Return (joints,) bool, whether any dof of a joint has a value other than 0."""
    chosen = np.zeros(model.njnt, bool)
    chosen[model.dof_jntid[_any_by_row(of_dofs)]] = True
    return chosen


def _of(model: mujoco.MjModel, feature: str, kind: str, where: Any) -> Iterator[str]:
    """Yield the feature with the names of the elements whose entries are not all 0."""
    rows = np.flatnonzero(_any_by_row(np.asarray(where)))
    if len(rows):
        yield f"{feature} ({kind} {_some([_name(model, kind, int(i)) for i in rows])})"


def _any_by_row(values: np.ndarray) -> np.ndarray:
    return (values != 0).any(axis=tuple(range(1, values.ndim)))


def _flags(model: mujoco.MjModel, *names: str) -> Iterator[str]:
    """Yield those MuJoCo flags that the model disables."""
    for name in names:
        bit = int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}"))
        if model.opt.disableflags & bit:
            yield f"flag {name}='disable'"


def _name(model: mujoco.MjModel, kind: str, index: int) -> str:
    return repr(getattr(model, kind)(index).name or f"{kind}/{index}")


def _some(names: list[str]) -> str:
    more = len(names) - _MOST_NAMES
    return ", ".join(names[:_MOST_NAMES]) + (f" and {more} more" if more > 0 else "")


def _label(enum: Any, value: int) -> str:
    return repr(enum(value).name.split("_", 1)[1].lower())
