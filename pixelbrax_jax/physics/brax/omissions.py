"""Features of a MuJoCo model that Brax's backends silently ignore and ``mj_step`` does not."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from pixelbrax_jax.physics.mujoco.compatibility import import_silenced
from pixelbrax_jax.physics.mujoco.opengl import mujoco

with import_silenced():
    from mujoco.mjx._src.collision_driver import geom_pairs

_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_BALL = int(mujoco.mjtJoint.mjJNT_BALL)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)

_BRAX_NUMERICS = {
    "constraint_stiffness",
    "constraint_limit_stiffness",
    "constraint_ang_damping",
    "constraint_vel_damping",
}
"""Stand for stiffness and damping in models written for Brax's backends."""

_MOST_NAMES = 5

_Rows = Iterator[tuple[str, str, Any]]
"""A feature, the kind of the elements that may have it (empty for the model itself), and for each
element whether it has: numbers that are not all 0."""


def check_simulated(model: mujoco.MjModel, backend: str) -> None:
    """Raise a ValueError with the fix if a backend ignores features of a compiled model."""
    missing, lost = omissions(model, backend), omissions(model, "mjx")
    if not missing:
        return
    fixes = [] if missing == lost else ["use backend='mjx'"]
    if lost:
        what = ", ".join(lost) if fixes else "it"
        fixes.append(f"remove {what} from the model, which no backend simulates")
    raise ValueError(
        f"the {backend!r} backend does not simulate {'; '.join(missing)}: {', and '.join(fixes)}."
    )


def omissions(model: mujoco.MjModel, backend: str) -> list[str]:
    """Return the features of a compiled model that a backend ignores, with their elements."""
    rows = [*_in_all(model)]
    if backend != "mjx":
        rows += [*_in_brax(model), *_of_actuators(model), *_of_contacts(model), *_of_options(model)]
    if backend in ("positional", "spring"):
        rows += _in_maximal(model)
    found = []
    for feature, kind, where in rows:
        having = np.flatnonzero(_any_by_row(np.atleast_1d(where)))
        if len(having) and kind:
            feature += f" ({kind} {_some([_name(model, kind, int(i)) for i in having])})"
        if len(having):
            found.append(feature)
    return found


def _in_all(model: mujoco.MjModel) -> _Rows:
    """Yield what MuJoCo XLA ignores, and therefore Brax."""
    yield "polynomial damping", "joint", _joints(model, model.dof_dampingpoly)
    yield "polynomial stiffness", "joint", model.jnt_stiffnesspoly
    yield "armature", "actuator", model.actuator_armature
    damping = np.column_stack([model.actuator_damping, model.actuator_dampingpoly])
    yield "damping", "actuator", damping
    yield "delay", "actuator", model.actuator_delay
    off = [bool(model.opt.disableactuator >> int(group) & 1) for group in model.actuator_group]
    yield "option actuatorgroupdisable", "actuator", off
    yield "ellipsoid fluid forces", "geom", model.geom_fluid
    yield "surface velocity", "geom", model.geom_surfacevel
    for kind in ("body", "actuator", "geom"):
        yield "plugin", kind, getattr(model, f"{kind}_plugin") >= 0
    yield _flag(model, "spring")
    yield _flag(model, "damper")


def _in_brax(model: mujoco.MjModel) -> _Rows:
    """Yield what each of Brax's own backends ignores of bodies and joints."""
    kind, free = model.jnt_type, model.jnt_type == _FREE
    yield "equality constraints", "equality", np.ones(model.neq)
    yield "tendons", "tendon", np.ones(model.ntendon)
    jointless = model.body_jntnum == 0
    jointless[0] = False
    yield "bodies without a joint", "body", jointless
    yield "more than three joints", "body", model.body_jntnum > 3
    yield "gravity compensation", "body", model.body_gravcomp
    yield "ball joints", "joint", kind == _BALL
    yield "frictionloss", "joint", _joints(model, model.dof_frictionloss)
    scalar, at = ~(free | (kind == _BALL)), model.jnt_qposadr
    yield "ref", "joint", scalar & (model.qpos0[at] != 0)
    sprung = model.jnt_stiffness != 0
    moved = model.qpos_spring[at] != model.qpos0[at]
    yield "springref", "joint", scalar & sprung & moved
    yield "stiffness of free joints", "joint", free & sprung
    yield "actuatorfrcrange", "joint", model.jnt_actfrclimited
    first = model.body_jntadr[model.jnt_bodyid]
    apart = (model.jnt_pos != model.jnt_pos[first]).any(axis=1)
    yield "joints of a body at different places", "joint", apart


def _of_actuators(model: mujoco.MjModel) -> _Rows:
    yield "transmission to other than joints", "actuator", ~_on_joint(model)
    fixed = model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED)
    unbiased = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_NONE)
    affine = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
    stateful = model.actuator_dyntype != int(mujoco.mjtDyn.mjDYN_NONE)
    yield "activation dynamics", "actuator", stateful
    yield "gain types other than fixed", "actuator", ~fixed
    yield "bias types other than none and affine", "actuator", ~(unbiased | affine)
    yield "constant bias", "actuator", affine & (model.actuator_biasprm[:, 0] != 0)
    other_axes = (model.actuator_gear[:, 1:] != 0).any(axis=1)
    unfit = _on_free_joint(model) & (other_axes | ~unbiased)
    yield "gear beyond the first axis of a free joint, or feedback on it", "actuator", unfit


def _of_contacts(model: mujoco.MjModel) -> _Rows:
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
        yield f"condim {dim} (geoms {_some(dims[dim])})", "", True
    yield f"friction that differs by direction (geoms {_some(slanted)})", "", bool(slanted)
    thick = (model.geom_type == mujoco.mjtGeom.mjGEOM_CYLINDER) & (model.geom_size[:, 1] > 0.001)
    yield "contacts of cylinders", "geom", solid & thick
    for name, default in (("priority", 0), ("solmix", 1)):
        values = getattr(model, f"geom_{name}")
        yield name, "geom", (values != default) & (values != values[:1]).any()


def _of_options(model: mujoco.MjModel) -> _Rows:
    for name in ("constraint", "gravity", "actuation"):
        yield _flag(model, name)
    if model.jnt_limited.any():
        yield _flag(model, "limit")
    if model.actuator_ctrllimited.any():
        yield _flag(model, "clampctrl")
    options = model.opt
    integrator = mujoco.mjtIntegrator(options.integrator)
    name = integrator.name.removeprefix("mjINT_").lower()
    yield f"option integrator={name!r}", "", integrator != mujoco.mjtIntegrator.mjINT_EULER
    yield "option cone='elliptic'", "", options.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL
    yield f"option impratio={options.impratio:g}", "", options.impratio != 1
    yield "option wind", "", options.wind.any()


def _in_maximal(model: mujoco.MjModel) -> _Rows:
    """Yield what only the backends with springs or corrections for joints ignore."""
    numerics = {model.numeric(i).name for i in range(model.nnumeric)}
    if not numerics & _BRAX_NUMERICS:
        yield "damping", "joint", _joints(model, model.dof_damping)
        yield "armature", "joint", _joints(model, model.dof_armature)
        yield "stiffness", "joint", model.jnt_stiffness
    yield "forces on a free joint", "actuator", _on_free_joint(model)
    hinge = model.jnt_type == _HINGE
    wide = hinge & (model.jnt_limited == 1) & (np.abs(model.jnt_range) > np.pi).any(axis=1)
    yield "limits beyond half a turn", "joint", wide
    bent = np.zeros(model.nbody, bool)
    for body in range(model.nbody):
        rows = slice(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
        kinds, axes = model.jnt_type[rows].tolist(), model.jnt_axis[rows]
        for chosen in (_HINGE, _SLIDE):
            same = axes[[kind == chosen for kind in kinds]]
            bent[body] |= not np.allclose(same @ same.T, np.eye(len(same)), atol=1e-4)
        mixed = _HINGE in kinds and _SLIDE in kinds
        bent[body] |= mixed and (kinds != sorted(kinds) or kinds.count(_HINGE) > 1)
    yield "joints of a body other than slides, then one hinge, at right angles", "body", bent


def _on_joint(model: mujoco.MjModel) -> np.ndarray:
    return model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)


def _on_free_joint(model: mujoco.MjModel) -> np.ndarray:
    chosen = _on_joint(model)
    chosen[chosen] = model.jnt_type[model.actuator_trnid[chosen, 0]] == _FREE
    return chosen


def _joints(model: mujoco.MjModel, of_dofs: np.ndarray) -> np.ndarray:
    chosen = np.zeros(model.njnt, bool)
    chosen[model.dof_jntid[_any_by_row(of_dofs)]] = True
    return chosen


def _any_by_row(values: np.ndarray) -> np.ndarray:
    return (values != 0).any(axis=tuple(range(1, values.ndim)))


def _flag(model: mujoco.MjModel, name: str) -> tuple[str, str, bool]:
    bit = int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}"))
    return f"flag {name}='disable'", "", bool(model.opt.disableflags & bit)


def _name(model: mujoco.MjModel, kind: str, index: int) -> str:
    return repr(getattr(model, kind)(index).name or f"{kind}/{index}")


def _some(names: list[str]) -> str:
    more = len(names) - _MOST_NAMES
    return ", ".join(names[:_MOST_NAMES]) + (f" and {more} more" if more > 0 else "")
