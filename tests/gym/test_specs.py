"""Time limits that wrappers bring, and specs that go through JSON."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import TimeLimit

import pixelbrax_gym
import pixelbrax_jax
from pixelbrax_jax import distractors
from tests.gym.conftest import ID, TASK
from tests.gym.test_registration import steps_until_truncated

until_truncated = partial(steps_until_truncated, at_most=3000)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"max_episode_steps": 1200}, 1200),
        pytest.param({"max_episode_steps": 1200, "action_repeat": 2}, 1200, marks=pytest.mark.slow),
        ({"max_episode_steps": 700, "action_repeat": 2}, 700),
        ({"max_episode_steps": 1200, "episode_length": 9}, 9),
        ({"action_repeat": 3}, 334),
    ],
)
def test_a_limit_beyond_the_default_is_heeded(options, expected):
    env = gymnasium.make(ID, obs_mode="state", **options)
    assert until_truncated(env) == expected
    assert until_truncated(gymnasium.make(env.spec)) == expected
    if "max_episode_steps" in options:
        assert env.spec.max_episode_steps == options["max_episode_steps"]
        if "episode_length" not in options:
            assert env.unwrapped.spec.max_episode_steps in (expected, 500)
    many = gymnasium.make_vec(ID, num_envs=2, vectorization_mode="sync", **options)
    many.reset(seed=0)
    for _ in range(expected):
        truncated = many.step(np.zeros((2, 1), np.float32))[3]
    assert truncated.all()


def test_a_limit_of_the_task_holds_at_every_door():
    single = gymnasium.make("PixelBrax/Gym-Reacher-v5", obs_mode="state", max_episode_steps=120)
    assert until_truncated(single) == 50
    assert single.unwrapped.spec.max_episode_steps == 50
    many = gymnasium.make_vec(
        "PixelBrax/Gym-Reacher-v5", num_envs=2, obs_mode="state", max_episode_steps=120
    )
    assert many.spec.max_episode_steps == 50


def test_a_time_limit_of_ones_own():
    bare = pixelbrax_gym.GymnasiumEnv(TASK, obs_mode="state")
    outer = TimeLimit(gymnasium.wrappers.TransformReward(TimeLimit(bare, 1300), abs), 1100)
    assert until_truncated(outer) == 1100
    # Of the environment itself nobody has asked for more.
    bare = pixelbrax_gym.GymnasiumEnv(TASK, obs_mode="state")
    other = TimeLimit(pixelbrax_gym.GymnasiumEnv(TASK, obs_mode="state"), 1100)
    other.reset(seed=0)
    assert until_truncated(bare) == 1000


def through_json(env):
    return gymnasium.make(EnvSpec.from_json(env.spec.to_json()))


OBJECTS = {
    "distractors": (distractors.Color(scale=0.2), "camera"),
    "camera": pixelbrax_jax.make_rig((0.0, -3.0, 1.0), (0.0, 0.0, 0.1), 45.0),
    "look": pixelbrax_jax.make_look("dmc", shadows=False),
}
SIZE = {"height": 12, "width": 12, "frame_stack": 1}


def test_objects_go_through_json():
    env = gymnasium.make(ID, **SIZE, **OBJECTS)
    again = through_json(env)
    assert again.spec == env.spec == through_json(again).spec
    one, other = (e.unwrapped._stateful for e in (env, again))
    assert one.env == other.env
    jax.tree.map(np.testing.assert_array_equal, one.params, other.params)
    np.testing.assert_array_equal(env.reset(seed=0)[0], again.reset(seed=0)[0])
    many = gymnasium.make_vec(ID, num_envs=2, **SIZE, **OBJECTS)
    again = gymnasium.make_vec(EnvSpec.from_json(many.spec.to_json()))
    assert again.spec == many.spec
    np.testing.assert_array_equal(many.reset(seed=0)[0], again.reset(seed=0)[0])


@dataclass(frozen=True)
class Darker(distractors.Distractor):
    """A distractor of a user's."""

    factor: float = 0.5
    kind = "darker"
    stream = 91

    def change_frame(self, state, frame, backdrop=None):
        return frame.replace(r=self.factor * frame.r)


def test_a_distractor_of_ones_own_and_a_folder_go_through_json():
    env = gymnasium.make(ID, **SIZE, distractors=[Darker(0.25)], clips=None)
    text = env.spec.to_json()
    assert '"type": "tests.gym.test_specs:Darker", "factor": 0.25' in text
    assert through_json(env).unwrapped._stateful.env.distractors == (Darker(0.25),)
    spec = gymnasium.make(ID, **SIZE, obs_mode="state", clips=Path("/nowhere")).spec
    assert '"clips": "/nowhere"' in spec.to_json()


def test_values_of_enumerations_go_through_json():
    env = gymnasium.make_vec(ID, num_envs=2, autoreset_mode=AutoresetMode.SAME_STEP, **SIZE)
    again = gymnasium.make_vec(EnvSpec.from_json(env.spec.to_json()))
    assert again.autoreset_mode == AutoresetMode.SAME_STEP


def test_a_class_of_no_module_is_named():
    @dataclass(frozen=True)
    class Local(distractors.Distractor):
        kind = "local"
        stream = 92

    with pytest.raises(ValueError, match="distractors="):
        gymnasium.make(ID, **SIZE, distractors=Local()).spec.to_json()


def test_what_json_has_nothing_for_is_named():
    bank = pixelbrax_jax.load_clips("procedural", height=12, width=12, num_clips=1)
    env = gymnasium.make(ID, **SIZE, distractors="video", clips=bank)
    with pytest.raises(ValueError, match=r"spec of PixelBrax/ToyBall-v0 cannot be .* clips="):
        env.spec.to_json()
    assert gymnasium.make(env.spec).spec.kwargs["clips"].digest == bank.digest


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"look": {"ground": "grid"}}, ValueError, "needs an entry 'type', one of Camera,"),
        ({"look": {"type": "Lok"}}, ValueError, "unknown entry 'type': 'Lok'.*'Look'"),
        ({"distractors": {"type": "color", "scal": 1}}, TypeError, "'scal'.*'scale'"),
        ({"distractors": [{"type": "no_such:Path"}]}, ValueError, "no_such:Path.*No module named"),
        (
            {"distractors": [{"type": "pathlib:Path"}]},
            ValueError,
            "'pathlib:Path' must be a subclass",
        ),
        ({"distractors": {"type": "color", "scale": -1.0}}, ValueError, "scale"),
        ({"camera": {"type": "color"}}, TypeError, "camera must be"),
    ],
)
def test_dictionaries_that_describe_nothing(options, error, message):
    with pytest.raises(error, match=message):
        pixelbrax_jax.make(TASK, **options)
