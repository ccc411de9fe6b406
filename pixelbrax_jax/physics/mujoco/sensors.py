"""What MuJoCo must compute for a model's sensors of positions and velocities."""

from __future__ import annotations

from pixelbrax_jax.physics.mujoco.opengl import mujoco

_SENSOR = mujoco.mjtSensor
_CAMERA = int(mujoco.mjtObj.mjOBJ_CAMERA)

_OF_CONSTRAINTS = {
    _SENSOR.mjSENS_JOINTLIMITPOS,
    _SENSOR.mjSENS_JOINTLIMITVEL,
    _SENSOR.mjSENS_TENDONLIMITPOS,
    _SENSOR.mjSENS_TENDONLIMITVEL,
    _SENSOR.mjSENS_CONTACT,
}
_OF_CHAINS = {
    _SENSOR.mjSENS_TENDONPOS,
    _SENSOR.mjSENS_TENDONVEL,
    _SENSOR.mjSENS_ACTUATORPOS,
    _SENSOR.mjSENS_ACTUATORVEL,
    _SENSOR.mjSENS_CAMPROJECTION,
}


def read_constraints(model: mujoco.MjModel) -> bool:
    """Return whether sensors read contacts or limits."""
    return _has(model, _OF_CONSTRAINTS)


def read_actuators(model: mujoco.MjModel) -> bool:
    """Return whether sensors read velocities of actuators."""
    return _has(model, {_SENSOR.mjSENS_ACTUATORVEL})


def read_more_than_bodies(model: mujoco.MjModel) -> bool:
    """Return whether sensors read more than MuJoCo computes for the motion of bodies."""
    of_camera = (model.sensor_objtype == _CAMERA) | (model.sensor_reftype == _CAMERA)
    return bool(of_camera.any()) or _has(model, _OF_CONSTRAINTS | _OF_CHAINS)


def _has(model: mujoco.MjModel, kinds: set[mujoco.mjtSensor]) -> bool:
    return not {int(kind) for kind in kinds}.isdisjoint(model.sensor_type.tolist())
