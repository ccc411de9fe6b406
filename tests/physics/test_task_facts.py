"""The table of tasks, against figures taken from Brax's models by hand."""

from collections import Counter

import jax
import numpy as np
import pytest

from pixelbrax_jax.physics.base import Physics
from pixelbrax_jax.physics.brax.tasks import BACKENDS as BRAX_BACKENDS
from pixelbrax_jax.registry import make_physics
from pixelbrax_jax.tasks import BRAX_TASKS
from pixelbrax_jax.types import GeomKind

# task: (planes, capsules, spheres), actions, observations, dt by backend
FACTS = {
    "ant": ((1, 12, 5), 8, 27, {"generalized": 0.05, "spring": 0.05}),
    "halfcheetah": ((1, 8, 0), 6, 17, {"generalized": 0.05, "spring": 0.05}),
    "hopper": ((1, 4, 0), 3, 11, {"generalized": 0.008, "positional": 0.008}),
    "humanoid": ((1, 12, 5), 17, 244, {"generalized": 0.015, "spring": 0.015}),
    "humanoidstandup": ((1, 12, 5), 17, 244, {"spring": 0.015}),
    "inverted_double_pendulum": ((1, 4, 0), 1, 8, {"generalized": 0.02, "spring": 0.02}),
    "inverted_pendulum": ((0, 3, 0), 1, 4, {"generalized": 0.04, "spring": 0.02}),
    # Brax's pusher has one sphere more, with alpha 0.
    "pusher": ((1, 13, 6), 7, 23, {"generalized": 0.05}),
    "reacher": ((1, 7, 2), 2, 11, {"generalized": 0.02, "spring": 0.02}),
    "swimmer": ((1, 3, 0), 2, 8, {"generalized": 0.04}),
    "walker2d": ((1, 7, 0), 6, 17, {"generalized": 0.008, "spring": 0.008}),
}


def test_all_eleven_tasks_of_brax():
    assert set(BRAX_TASKS) == set(FACTS)


@pytest.mark.parametrize("task", sorted(FACTS))
def test_sizes(task, program):
    kinds, actions, observations, _ = FACTS[task]
    physics = program(task).physics
    assert isinstance(physics, Physics)
    count = Counter(physics.geoms.kind)
    assert tuple(count[k] for k in (GeomKind.PLANE, GeomKind.CAPSULE, GeomKind.SPHERE)) == kinds
    assert physics.action_size == actions
    assert physics.state_size == observations
    assert physics.backend == BRAX_TASKS[task].default_backend
    assert len(set(physics.link_names)) == len(physics.link_names)


@pytest.mark.parametrize("task", sorted(FACTS))
def test_dt_is_the_models_own_number(task, program):
    dt = FACTS[task][3]
    physics = program(task).physics
    assert physics.dt == dt[physics.backend]


@pytest.mark.parametrize("task", ["inverted_pendulum", "inverted_double_pendulum"])
def test_dt_depends_on_the_backend(task):
    for backend, dt in FACTS[task][3].items():
        assert make_physics(task, backend=backend).dt == dt


@pytest.mark.parametrize("task", sorted(FACTS))
def test_default_backend_is_supported(task):
    spec = BRAX_TASKS[task]
    assert spec.default_backend in spec.backends
    assert set(spec.backends) <= set(BRAX_BACKENDS)
    assert list(spec.backends) == sorted(spec.backends)


@pytest.mark.parametrize("task", sorted(FACTS))
def test_geoms_do_not_leak_the_engine(task, program):
    geoms = program(task).physics.geoms
    for value in (*geoms.kind, *geoms.link, *geoms.material):
        assert type(value) is int
    assert all(type(name) is str for name in geoms.name)
    for leaf in jax.tree.leaves(geoms):
        assert leaf.dtype == np.float32
    number = len(geoms.kind)
    assert geoms.size.shape == (number, 3)
    assert geoms.pos.shape == (number, 3)
    assert geoms.quat.shape == (number, 4)
    assert geoms.rgb.shape == (max(geoms.material) + 1, 3)
    assert set(geoms.material) == set(range(len(geoms.rgb)))
    hash((geoms.kind, geoms.link, geoms.material, geoms.name))


def test_equal_calls_give_equal_physics():
    one, two = make_physics("reacher"), make_physics("reacher")
    assert one == two
    assert hash(one) == hash(two)
    assert one != make_physics("reacher", backend="spring")
    assert jax.tree.structure(one.geoms) == jax.tree.structure(two.geoms)
    jax.tree.map(np.testing.assert_array_equal, one.geoms, two.geoms)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"task": "antt"},
            r"unknown task: 'antt'; allowed: ant, dmc_.*, halfcheetah, .*\. Did you mean 'ant'\?",
        ),
        ({"task": "Walker2d"}, "Did you mean 'walker2d'?"),
        ({"task": None}, "unknown task: None; allowed: ant"),
        (
            {"task": "ant", "backend": "sprng"},
            r"unknown backend of task 'ant': 'sprng'; allowed: generalized, mjx, spring\. "
            r"Did you mean 'spring'\?",
        ),
        (
            {"task": "swimmer", "backend": "mjx"},
            "unknown backend of task 'swimmer': 'mjx'; allowed: generalized",
        ),
        (
            {"task": "ant", "reward_preset": "papr"},
            r"unknown reward_preset: 'papr'; allowed: brax, paper\. Did you mean 'paper'\?",
        ),
    ],
)
def test_unknown_names(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_physics(**arguments)
