"""What MuJoCo XLA leaves out of a model is refused by name; what it simulates is not."""

import re

import mujoco
import numpy as np
import pytest

from pixelbrax_jax.physics.dmc.models import load_spec
from pixelbrax_jax.physics.dmc.tasks import TASKS
from pixelbrax_jax.physics.mujoco.native import compile_model
from pixelbrax_jax.physics.mujoco.omissions import check_simulated

ARM = """
<mujoco>
  <option timestep=".005"/>
  <default><default class="ghost"><geom contype="0" conaffinity="0"/></default></default>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 1" pos="0 0 -.2"/>
    <body name="arm">
      <joint name="shoulder" axis="0 1 0"/>
      <geom name="arm" type="capsule" fromto="0 0 0 .3 0 0" size=".04" class="ghost"/>
      <body name="hand" pos=".3 0 0">
        <joint name="elbow" axis="0 1 0"/>
        <geom name="hand" type="capsule" fromto="0 0 0 .3 0 0" size=".03" class="ghost"/>
      </body>
    </body>
    <body name="ball" pos="0 1 -.08">
      <joint name="ball" type="free"/>
      <geom name="ball" size=".1"/>
    </body>
  </worldbody>
  <tendon><fixed name="rope"><joint joint="elbow" coef="1"/></fixed></tendon>
  <actuator><motor name="push" joint="elbow" gear="2"/></actuator>
</mujoco>
"""


def more(place):
    """Adds attributes where the arm has ``place``."""
    return lambda attributes: [(place, f"{place} {attributes}")]


OPTION = '<option timestep=".005"'
option, elbow = more(OPTION), more('"elbow" axis="0 1 0"')
motor, hand = more('<motor name="push" joint="elbow"'), more('<geom name="hand"')
floor, rope = more('<geom name="floor"'), more('<fixed name="rope"')


def flag(name):
    return [(OPTION + "/>", f'{OPTION}><flag {name}="disable"/></option>')]


SPRING, WATERY = elbow('stiffness="3"'), option('density="1000"')

# The third column, where a feature changes nothing by itself, is what it is compared with.
FEATURES = [
    ("polynomial damping (joint 'elbow')", elbow('damping="1 .5 .3"'), elbow('damping="1"')),
    ("polynomial stiffness (joint 'elbow')", elbow('stiffness="3 .5 9"'), SPRING),
    ("polynomial damping (tendon 'rope')", rope('damping="1 .5 .3"'), rope('damping="1"')),
    ("polynomial stiffness (tendon 'rope')", rope('stiffness="3 .5 9"'), rope('stiffness="3"')),
    ("armature (actuator 'push')", motor('armature=".1"'), []),
    ("damping (actuator 'push')", motor('damping=".5"'), []),
    ("option actuatorgroupdisable (actuator 'push')", option('actuatorgroupdisable="0"'), []),
    ("ellipsoid fluid forces (geom 'hand')", WATERY + hand('fluidshape="ellipsoid"'), WATERY),
    ("surface velocity (geom 'floor')", floor('surfacevel="1 0 0"'), []),
    ("flag spring='disable'", SPRING + flag("spring"), SPRING),
    ("flag damper='disable'", elbow('damping="1"') + flag("damper"), elbow('damping="1"')),
]


def build(changes):
    xml = ARM
    for old, new in changes:
        assert old in xml
        xml = xml.replace(old, new)
    return mujoco.MjModel.from_xml_string(xml)


def motion(changes):
    """Places and velocities of the bodies after half a second in MuJoCo."""
    model = build(changes)
    data = mujoco.MjData(model)
    data.qvel[-6:] = (0.5, 0.2, 0.0, 1.0, 2.0, 3.0)
    data.ctrl[:] = 0.6
    mujoco.mj_step(model, data, 100)
    return data.xpos.copy(), data.cvel.copy()


@pytest.mark.parametrize(("feature", "changes", "without"), FEATURES)
def test_what_is_refused_moves_a_model(feature, changes, without):
    """So that nothing harmless is refused."""
    there, here = motion(changes), motion(without)
    assert max(np.abs(a - b).max() for a, b in zip(there, here, strict=True)) > 1e-4
    with pytest.raises(ValueError, match=re.escape(feature)):
        check_simulated(build(changes))
    check_simulated(build(without))


def test_everything_is_named_at_once_with_the_fix():
    changes = flag("spring") + motor('armature=".1"')
    message = (
        "MuJoCo XLA does not simulate armature (actuator 'push'); flag spring='disable': compute "
        "on a CPU, with engine='mujoco', or remove it from the model."
    )
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        check_simulated(build(changes))


def test_long_lists_end():
    crowd = "".join('<body><joint stiffness="1 1"/><geom size=".1"/></body>' for _ in range(9))
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{crowd}</worldbody></mujoco>")
    with pytest.raises(ValueError, match="'joint/4' and 4 more"):
        check_simulated(model)


@pytest.mark.parametrize("domain", sorted({row.domain for row in TASKS.values()}))
def test_the_suites_models_pass(domain):
    pytest.importorskip("dm_control")
    needs = {"swimmer": {"num_bodies": 6}, "quadruped": {"floor_size": 1}}
    options = needs.get(domain, {"max_contacts": 4} if domain == "manipulator" else {})
    check_simulated(compile_model(load_spec(domain, **options)))
