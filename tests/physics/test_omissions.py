"""What a backend leaves out of a model is refused by name; what it simulates is not."""

import re
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
import pytest

from pixelbrax_jax.physics.brax.omissions import check_simulated, omissions
from pixelbrax_jax.physics.brax.tasks import BACKENDS as BRAX_BACKENDS

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
  <actuator><motor name="push" joint="elbow" gear="2"/></actuator>
</mujoco>
"""
END = "</mujoco>"
PUSH = '<motor name="push" joint="elbow" gear="2"/>'


def more(place):
    """Adds attributes where the arm has ``place``."""
    return lambda attributes: [(place, f"{place} {attributes}")]


ELBOW, OPTION = '"elbow" axis="0 1 0"', '<option timestep=".005"'
elbow, option, motor = more(ELBOW), more(OPTION), more('<motor name="push" joint="elbow"')
arm, hand = more('<body name="arm"'), more('<geom name="hand"')
ball, floor = more('<geom name="ball"'), more('<geom name="floor"')


def flag(name):
    return [(OPTION + "/>", f'{OPTION}><flag {name}="disable"/></option>')]


def push(actuator):
    return [(PUSH, actuator)]


def general(attributes):
    return push(f'<general name="push" joint="elbow" gear="2" {attributes}/>')


def at_the_end(element):
    return [(END, element + END)]


SPRING, LIMITS, WATER = elbow('stiffness="3"'), elbow('range="-20 20"'), 'density="1000"'
CLAMPED = motor('ctrlrange="-.1 .1"')
SPRUNG = '<fixed name="pull" stiffness="9"><joint joint="elbow" coef="2"/></fixed>'
LOCK = '<equality><joint name="lock" joint1="elbow"/></equality>'
SLANTED = '<pair geom1="floor" geom2="ball" friction="1 .01 .005 1e-4 1e-4"/>'
WATERY = option(WATER)

# The third column, where a feature changes nothing by itself, is what it is compared with.
EVERYWHERE = [
    ("polynomial damping (joint 'elbow')", elbow('damping="1 .5 .3"'), elbow('damping="1"')),
    ("polynomial stiffness (joint 'elbow')", elbow('stiffness="3 .5 9"'), SPRING),
    ("armature (actuator 'push')", motor('armature=".1"')),
    ("damping (actuator 'push')", motor('damping=".5"')),
    ("delay (actuator 'push')", motor('delay=".05" nsample="20"')),
    ("option actuatorgroupdisable (actuator 'push')", option('actuatorgroupdisable="0"')),
    ("ellipsoid fluid forces (geom 'hand')", WATERY + hand('fluidshape="ellipsoid"'), WATERY),
    ("surface velocity (geom 'floor')", floor('surfacevel="1 0 0"')),
    ("flag spring='disable'", SPRING + flag("spring"), SPRING),
    ("flag damper='disable'", elbow('damping="1"') + flag("damper"), elbow('damping="1"')),
]
IN_BRAX = [
    ("frictionloss (joint 'elbow')", elbow('frictionloss=".5"')),
    ("springref (joint 'elbow')", elbow('stiffness="3" springref="40"'), SPRING),
    ("actuatorfrcrange (joint 'elbow')", elbow('actuatorfrcrange="-.1 .1"')),
    ("gravity compensation (body 'arm')", arm('gravcomp="1"')),
    ("equality constraints (equality 'lock')", at_the_end(LOCK)),
    ("tendons (tendon 'pull')", at_the_end(f"<tendon>{SPRUNG}</tendon>")),
    ("activation dynamics (actuator 'push')", general('dyntype="filter" dynprm=".1"')),
    ("constant bias (actuator 'push')", general('biastype="affine" biasprm="2 0 0"')),
    ("gain types other than fixed (actuator 'push')", general('gaintype="affine" gainprm="1 3 0"')),
    (
        "transmission to other than joints (actuator 'push')",
        [
            (PUSH, '<motor name="push" site="tip" gear="0 0 1 0 0 0"/>'),
            ('<geom name="hand"', '<site name="tip"/><geom name="hand"'),
        ],
    ),
    (
        "gear beyond the first axis of a free joint, or feedback on it (actuator 'push')",
        push('<motor name="push" joint="ball" gear="0 0 50 0 0 0"/>'),
        push('<motor name="push" joint="ball" gear="0 0 0 0 0 0"/>'),
    ),
    ("condim 1 (geoms 'floor' and 'ball')", ball('condim="1"') + floor('condim="1"')),
    ("condim 6 (geoms 'floor' and 'ball')", ball('condim="6" friction="1 .1 .1"')),
    (
        "friction that differs by direction (geoms 'floor' and 'ball')",
        at_the_end(f"<contact>{SLANTED}</contact>"),
    ),
    ("option wind", option(f'{WATER} wind="1 0 2"'), WATERY),
    ("option integrator='rk4'", option('integrator="RK4"')),
    ("flag constraint='disable'", LIMITS + flag("constraint"), LIMITS),
    ("flag limit='disable'", LIMITS + flag("limit"), LIMITS),
    ("flag gravity='disable'", flag("gravity")),
    ("flag actuation='disable'", flag("actuation")),
    ("flag clampctrl='disable'", CLAMPED + flag("clampctrl"), CLAMPED),
]
IN_MAXIMAL = [
    ("damping (joint 'elbow')", elbow('damping=".5"')),
    ("armature (joint 'elbow')", elbow('armature=".5"')),
    ("stiffness (joint 'elbow')", SPRING),
    (
        "forces on a free joint (actuator 'push')",
        push('<motor name="push" joint="ball" gear="50 0 0 0 0 0"/>'),
        push(""),
    ),
]
# What single backends have no formula for.
ODD = [
    ("priority (geom 'ball')", ball('priority="1"')),
    ("option cone='elliptic'", option('cone="elliptic"')),
    ("option impratio=2", option('impratio="2"')),
    ("ref (joint 'elbow')", elbow('ref="30"')),
    ("ball joints (joint 'elbow')", [(ELBOW, '"elbow" type="ball"'), (PUSH, "")]),
    ("limits beyond half a turn (joint 'elbow')", elbow('range="-200 200"')),
    (
        "joints of a body other than slides, then one hinge, at right angles (body 'hand')",
        [(ELBOW, f'{ELBOW}/><joint type="slide"')],
    ),
    (
        "joints of a body at different places (joint 'elbow')",
        [(ELBOW, f'"first" axis="1 0 0"/><joint pos=".1 0 0" name={ELBOW}')],
    ),
    ("more than three joints (body 'hand')", [(ELBOW, ELBOW + '/><joint type="slide"' * 3)]),
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


def features(changes, backend):
    return omissions(build(changes), backend)


ALL = [(*row, [])[:3] for row in [*EVERYWHERE, *IN_BRAX, *IN_MAXIMAL]]


@pytest.mark.parametrize(("feature", "changes", "without"), ALL, ids=[row[0] for row in ALL])
def test_what_is_refused_moves_a_model(feature, changes, without):
    """So that nothing harmless is refused."""
    del feature
    there, here = motion(changes), motion(without)
    assert max(np.abs(a - b).max() for a, b in zip(there, here, strict=True)) > 1e-4


@pytest.mark.parametrize("backend", BRAX_BACKENDS)
@pytest.mark.parametrize(("feature", "changes", "without"), ALL, ids=[row[0] for row in ALL])
def test_each_backend_refuses_what_it_leaves_out(feature, changes, without, backend):
    rows = [row[0] for row in EVERYWHERE]
    rows += [row[0] for row in IN_BRAX] if backend != "mjx" else []
    rows += [row[0] for row in IN_MAXIMAL] if backend in ("positional", "spring") else []
    assert (feature in features(changes, backend)) == (feature in rows)
    assert feature not in features(without, backend)


@pytest.mark.parametrize(("feature", "changes"), ODD, ids=[row[0] for row in ODD])
def test_what_only_some_backends_have_no_formula_for(feature, changes):
    assert feature in features(changes, "spring")
    assert features(changes, "mjx") == []


@pytest.mark.parametrize("backend", BRAX_BACKENDS)
def test_a_plain_model_passes(backend):
    check_simulated(build([]), backend)


def test_everything_is_named_at_once_with_the_fix():
    changes = elbow('frictionloss=".5"') + flag("gravity")
    message = (
        "the 'generalized' backend does not simulate frictionloss (joint 'elbow'); "
        "flag gravity='disable': use backend='mjx'."
    )
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        check_simulated(build(changes), "generalized")
    changes += motor('delay=".05" nsample="20"')
    with pytest.raises(
        ValueError, match=r"use backend='mjx', and remove delay \(actuator 'push'\) f"
    ):
        check_simulated(build(changes), "generalized")
    with pytest.raises(
        ValueError, match=r"'push'\): remove it from the model, which no backend si"
    ):
        check_simulated(build(changes), "mjx")


def test_an_actuator_of_a_site_has_no_joint():
    for joint, row in (("", "bodies without a joint"), ("<joint/>", "transmission")):
        model = mujoco.MjModel.from_xml_string(
            f"<mujoco><worldbody><body>{joint}<geom size='.1'/><site/><site/><site name='end'/>"
            "</body></worldbody><actuator><motor name='pull' site='end'/></actuator></mujoco>"
        )
        found = omissions(model, "spring")
        assert found[-1] == "transmission to other than joints (actuator 'pull')"
        assert found[0].startswith(row)


def test_long_lists_end():
    crowd = "".join('<body><joint frictionloss="1"/><geom size=".1"/></body>' for _ in range(9))
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{crowd}</worldbody></mujoco>")
    assert "'joint/4' and 4 more)" in omissions(model, "generalized")[0]


def test_numerics_of_brax_stand_for_damping():
    numeric = '<custom><numeric name="constraint_ang_damping" data="20"/></custom>'
    changes = [*elbow('damping=".5" armature="1" stiffness="3"'), (END, numeric + END)]
    assert features(changes, "positional") == []


@pytest.mark.filterwarnings("ignore:compiler attribute")
@pytest.mark.parametrize(
    ("package", "folder", "backends"),
    [
        ("brax", "envs/assets", ("mjx", "generalized")),
        ("gymnasium", "envs/mujoco/assets", ("mjx",)),
        ("dm_control", "suite", ("mjx",)),
    ],
)
def test_models_of_others_pass(package, folder, backends):
    pytest.importorskip(package)
    count = 0
    for path in (Path(find_spec(package).origin).parent / folder).glob("*.xml"):
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compiler.fusestatic = True
        try:
            model = spec.compile()
        except ValueError:
            continue  # Meshes that are downloaded apart.
        count += 1
        for backend in backends:
            check_simulated(model, backend)
    assert count > 10
