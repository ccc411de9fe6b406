"""DM Control's models, read from the installed package without importing it."""

from __future__ import annotations

import hashlib
import sys
import warnings
from collections.abc import Callable
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

from pixelbrax_jax.extras import install_extra
from pixelbrax_jax.physics.mujoco.opengl import mujoco

KNOWN_VERSION = "1.0.50"
"""Release of dm_control whose models the tests compare with."""

KNOWN_MODELS = {
    "acrobot": "318565bb75f5587f",
    "ball_in_cup": "aed8880a33227847",
    "cartpole": "049fc7484ab1a118",
    "cheetah": "e200f6f051961105",
    "finger": "b849081be69e1470",
    "fish": "82214f68b3ec4770",
    "hopper": "c14ce94c4bc108d7",
    "humanoid": "f18638be4e464429",
    "manipulator": "608a06bb47623612",
    "pendulum": "c5c4b0342074bbdb",
    "point_mass": "a9b36a3581197253",
    "quadruped": "0fb169bde60fc592",
    "reacher": "5eb539927a2e8933",
    "swimmer": "aab420a1503b7e2c",
    "walker": "e5efd523aa043683",
}
"""Domain -> start of the SHA-256 of its XML file and included files in that release."""

_NO_WHEELS = (3, 13)
"""First Python without wheels for dm_control's requirements; its models can still be read."""

_TO_MAKE = 8
"""Stack level from the warning here to the caller of ``pixelbrax_jax.make``."""

_warned: list[str] = []
"""Domain of the only warning given in this process."""

_INCLUDED = ("common/materials.xml", "common/skybox.xml", "common/visual.xml")


def load_spec(domain: str, **options: float) -> mujoco.MjSpec:
    """Read the model of a domain.

    Options of the domain's generator are ``max_contacts`` (manipulator), ``num_bodies`` (swimmer)
    and ``floor_size`` in metres (quadruped). Without dm_control it raises an ImportError.
    """
    folder = _suite_folder()
    files = {name: (folder / name).read_bytes() for name in (f"{domain}.xml", *_INCLUDED)}
    _warn_if_unknown(domain, files)
    xml = files.pop(f"{domain}.xml").decode()
    if domain in _GENERATORS:
        root = ElementTree.fromstring(xml)
        _GENERATORS[domain](root, **options)
        xml = ElementTree.tostring(root, encoding="unicode")
    return mujoco.MjSpec.from_string(xml, include=files)


def _suite_folder() -> Path:
    spec = find_spec("dm_control")
    for folder in (spec and spec.submodule_search_locations) or ():
        if Path(folder, "suite").is_dir():
            return Path(folder, "suite")
    raise ImportError(
        "dm_control is not installed, from which tasks of the DM Control Suite read their models; "
        f"try: {how_to_install()}"
    )


def how_to_install() -> str:
    """Return the command that installs dm_control, which the extra omits on newer Pythons."""
    if sys.version_info >= _NO_WHEELS:
        return "pip install --no-deps dm_control"
    return install_extra("dmc")


def _warn_if_unknown(domain: str, files: dict[str, bytes]) -> None:
    # Independent of line ends.
    content = b"".join(files[name].replace(b"\r\n", b"\n") for name in sorted(files))
    if _warned or hashlib.sha256(content).hexdigest()[:16] == KNOWN_MODELS[domain]:
        return
    _warned.append(domain)
    try:
        installed = metadata.version("dm_control")
    except metadata.PackageNotFoundError:
        installed = "of an unknown version"
    warnings.warn(
        f"dm_control {installed} has another model of {domain!r} than "
        f"dm_control {KNOWN_VERSION}, with which the tasks of PixelBrax are compared: results may "
        f'differ from those of others. pip install "dm_control=={KNOWN_VERSION}" has the model '
        "that is known.",
        UserWarning,
        stacklevel=_TO_MAKE,
    )


def _find(root: ElementTree.Element, path: str) -> ElementTree.Element:
    element = root.find(path)
    if element is None:
        raise ValueError(f"the model of dm_control has no element {path}.")
    return element


def _grow_swimmer(root: ElementTree.Element, *, num_bodies: int) -> None:
    """Append equal bodies with motors and sensors to the swimmer's head, as DM Control does."""
    parent = _find(root, "./worldbody/body")
    actuator = ElementTree.SubElement(root, "actuator")
    sensor = _find(root, "./sensor")
    bend = 360.0 / num_bodies
    for camera in parent.findall("camera"):
        if camera.get("mode") == "trackcom":
            place = [float(number) * (num_bodies / 6.0) for number in camera.attrib["pos"].split()]
            camera.set("pos", " ".join(map(str, place)))
    for i in range(num_bodies - 1):
        body = ElementTree.SubElement(parent, "body", name=f"segment_{i}", pos="0 .1 0")
        for role in ("visual", "inertial"):
            ElementTree.SubElement(body, "geom", {"class": role, "name": f"{role}_{i}"})
        ElementTree.SubElement(body, "site", name=f"site_{i}")
        ElementTree.SubElement(body, "joint", name=f"joint_{i}", range=f"{-bend} {bend}")
        ElementTree.SubElement(actuator, "motor", name=f"motor_{i}", joint=f"joint_{i}")
        for kind in ("velocimeter", "gyro"):
            ElementTree.SubElement(sensor, kind, name=f"{kind}_{i}", site=f"site_{i}")
        parent = body


def _strip_quadruped(root: ElementTree.Element, *, floor_size: float) -> None:
    """Remove what walking does not need; half an edge of the floor is ``floor_size`` metres."""
    _find(root, ".//geom[@name='floor']").set("size", f"{floor_size} {floor_size} .5")
    walls = [f"geom[@name='wall_{side}']" for side in ("px", "py", "nx", "ny")]
    unused = [*walls, "geom[@name='terrain']", "site[@name='target']", "body[@name='ball']"]
    for path in unused:
        world = _find(root, "./worldbody")
        world.remove(_find(world, path))
    sensor = _find(root, "./sensor")
    for rangefinder in sensor.findall("rangefinder"):
        sensor.remove(rangefinder)


def _keep_ball(root: ElementTree.Element, *, max_contacts: int) -> None:
    """Remove all props but the ball; MuJoCo XLA uses the deepest ``max_contacts``."""
    world = _find(root, "./worldbody")
    for name in ("cup", "peg", "slot", "target_peg"):
        world.remove(_find(world, f"body[@name='{name}']"))
    custom = ElementTree.SubElement(root, "custom")
    ElementTree.SubElement(custom, "numeric", name="max_contact_points", data=str(max_contacts))


_GENERATORS: dict[str, Callable[..., None]] = {
    "manipulator": _keep_ball,
    "quadruped": _strip_quadruped,
    "swimmer": _grow_swimmer,
}
"""Domain -> changes of its XML before it is compiled."""
