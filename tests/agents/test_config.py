"""Settings: a bad one is told by its name, with its value and with what is allowed."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from pixelbrax_jax.agents.config import TrainConfig, describe, make_env
from pixelbrax_jax.agents.on_policy.config import OnPolicyConfig
from pixelbrax_jax.agents.on_policy.dcpg import DCPGConfig
from pixelbrax_jax.agents.on_policy.ppg import PPGConfig
from pixelbrax_jax.agents.on_policy.ppo import PPO, PPOConfig
from pixelbrax_jax.agents.registry import ALGORITHMS, make_train
from pixelbrax_jax.agents.runner.settings import RunConfig
from pixelbrax_jax.config import EnvConfig
from pixelbrax_jax.distractors.video import Video
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.types import Camera
from tests.agents.small import SMALL, ball_envs, settings_of

CONFIGS = tuple(kind.config_class for kind in ALGORITHMS.values())

COUNTS = (
    "height", "width", "frame_stack", "action_repeat", "episode_length", "total_steps", "num_envs",
    "num_steps", "num_minibatches", "update_epochs", "policy_epochs", "value_epochs",
    "num_policy_phases", "aux_minibatches", "buffer_size", "learning_starts", "batch_size",
    "n_step", "policy_delay", "num_atoms", "feature_dim", "hidden_dim", "std_steps",
)  # fmt: skip
COUNTS_OR_0 = ("random_shift", "aux_epochs", "num_starts")
SHARES = ("gamma", "gae_lambda", "clip_coef", "target_rate", "tau")
POSITIVE = (
    "learning_rate", "initial_std", "adam_eps", "memory_budget_gb", "target_kl", "replay_ratio",
    "final_std", "std_clip",
)  # fmt: skip
FINITE = ("v_min", "v_max")
POSITIVE_OR_0 = (
    "max_grad_norm", "ent_coef", "vf_coef", "beta_clone", "aux_value_coef", "value_distill_coef",
    "dynamics_coef", "saturation_coef",
)  # fmt: skip
CHOICES = ("encoder", "policy", "normalize_advantage", "layout", "critic")
BOOLS = (
    "state_critic", "anneal", "normalize_reward", "clip_value", "decoupled", "checkpoint_replay",
    "layer_norm", "bfloat16",
)  # fmt: skip
UNCHECKED = {
    # Options of the environment, checked with those of every other one.
    "task", "backend", "engine", "reward_preset", "distractors", "clips", "camera", "look",
    "shadows", "samples", "split", "obs_mode", "renderer", "dynamics", "test_dynamics",
    "camera_sizes",
}  # fmt: skip
NAN, INF = float("nan"), float("inf")

BAD = [
    (COUNTS, "a positive integer", (0, -3, 1.5, True, "8")),
    (COUNTS_OR_0, "a whole number of at least 0", (-1, 1.5, True, "8")),
    (SHARES, r"lie in \[0, 1\]", (-0.1, 1.5, NAN, "1")),
    (POSITIVE, "a positive number", (0, -1.0, NAN, INF, "1")),
    (POSITIVE_OR_0, "at least 0", (-1.0, NAN, INF, "1")),
    (FINITE, "a finite number", (NAN, INF, True, "1")),
    (BOOLS, "True or False", ("False", 0, None)),
    (CHOICES, "unknown .*llowed: .*, ", ("Nonesuch", None, 3)),
]


@pytest.mark.parametrize("config", CONFIGS)
def test_a_bad_setting_is_named_with_its_value_and_what_is_allowed(config):
    default = config()
    names = set(describe(default))
    for settings, allowed, values in BAD:
        for name in names.intersection(settings):
            for value in values:
                with pytest.raises((ValueError, TypeError), match=allowed) as info:
                    default.replace(**{name: value})
                assert name in str(info.value)
                assert repr(value) in str(info.value)
    checked = {name for settings, _, _ in BAD for name in settings}
    assert names - checked <= UNCHECKED, "every number and choice is checked"


CONTRADICTIONS = [
    (PPOConfig, {"num_steps": 12, "num_minibatches": 5},
     "num_minibatches=5 must divide num_steps=12; it may be 1, 2, 3, 4, 6, 12."),
    (PPOConfig, {"encoder": "nature", "height": 40, "width": 35},
     "encoder 'nature' needs images of at least 36 x 36 pixels, got 40 x 35"),
    (PPOConfig, {"encoder": "impalla"}, "Did you mean 'impala'"),
    (PPOConfig, {"layout": "shared", "state_critic": True},
     "state_critic needs layout='separate', got 'shared'"),
    (PPGConfig, {"layout": "detach", "state_critic": True},
     "state_critic needs layout='dual', got 'detach'"),
    (PPGConfig, {"layout": "detach", "policy_epochs": 2},
     "policy_epochs=2 and value_epochs=1 may differ only with layout='dual', got 'detach'"),
    (PPOConfig, {"initial_std": 8.0},
     "initial_std must be between 0.0067 and 7.39, the limits of standard deviations"),
    (DCPGConfig, {"aux_epochs": 0}, "aux_epochs must be a positive integer, got 0"),
    (DCPGConfig, {"state_critic": True}, "state_critic needs decoupled=True, got False"),
    (PPGConfig, {"num_policy_phases": 16, "aux_minibatches": 24},
     "aux_minibatches=24 must be a multiple of num_policy_phases=16"),
    (PPGConfig, {"num_steps": 64, "num_policy_phases": 2, "aux_minibatches": 6},
     "aux_minibatches / num_policy_phases=3 must divide num_steps=64; it may be 1, "),
    (DCPGConfig, {"num_policy_phases": 8, "total_steps": 256 * 64 * 7, "aux_minibatches": 8},
     f"after every 8 rollouts, and total_steps={256 * 64 * 7} are only 7"),
    (DCPGConfig, {"dynamics_coef": 0.5, "aux_minibatches": 1024},
     "dynamics_coef=0.5 needs at least 2 steps in a chunk, got 1: aux_minibatches=1024 must "
     "be less than num_steps * num_policy_phases=1024"),
]  # fmt: skip


@pytest.mark.parametrize(("config", "settings", "message"), CONTRADICTIONS)
def test_settings_that_contradict_each_other_are_told(config, settings, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        config().replace(**settings)


def test_what_training_cannot_use_of_an_environment_is_told():
    camera = Camera(np.zeros(3), np.eye(3), np.float32(45.0))
    with pytest.raises(TypeError, match="camera of training settings must be a name, got Camera"):
        PPOConfig(env=EnvConfig(camera=camera))
    with pytest.raises(TypeError, match=r"distractors of training settings must be names, got \("):
        PPOConfig(env=EnvConfig(distractors=Video()))
    with pytest.raises(ValueError, match="must be 'pixels' or 'depth', got 'both'"):
        PPOConfig(env=EnvConfig(obs_mode="both"))
    with pytest.raises(TypeError, match="env must be an EnvConfig, got 'ant'"):
        PPOConfig(env="ant")
    with pytest.raises(TypeError, match=r"argument 'heigth'; allowed: .*Did you mean 'height'"):
        PPOConfig().replace(heigth=64)


def test_a_run_too_short_for_an_auxiliary_phase_may_do_without_one():
    config = PPGConfig(total_steps=1, aux_epochs=0)
    assert config.num_iterations == 1


def test_iterations_are_rounded_up_and_count_control_steps():
    config = OnPolicyConfig(
        env=EnvConfig(action_repeat=4), num_envs=3, num_steps=16, total_steps=3 * 16 * 4 + 1
    )
    assert config.steps_per_iteration == 192
    assert config.num_iterations == 2


@pytest.mark.parametrize("config", CONFIGS)
def test_a_description_is_json_and_gives_the_settings_back(config):
    changed = config().replace(distractors=("video", "dcs-easy"), num_envs=6)
    settings = json.loads(json.dumps(describe(changed)))
    assert settings["num_envs"] == 6
    assert config().replace(**settings) == changed


def test_numbers_of_numpy_become_those_of_python():
    given = {"num_envs": np.int64(4), "gamma": np.float32(0.5), "anneal": np.bool_(True)}
    described = describe(PPOConfig(**given, target_kl=np.float64(0.25)))
    wanted = {"num_envs": 4, "gamma": 0.5, "anneal": True, "target_kl": 0.25}
    assert {name: json.loads(json.dumps(described))[name] for name in wanted} == wanted
    assert type(RunConfig(seed=np.int64(3)).seed) is int


def test_the_environment_is_the_one_that_is_described():
    wanted = EnvConfig(
        task="inverted_pendulum", height=20, width=24, frame_stack=2, action_repeat=3,
        episode_length=50,
    )  # fmt: skip
    config = TrainConfig(env=wanted, encoder="small", state_critic=True)
    env, params = make_env(config)
    assert env.obs_spec["pixels"].shape == (20, 24, 6)
    assert (env.action_repeat, params.episode_length) == (3, 50)
    # Only a critic that sees it makes the state an observation.
    assert make_env(config, obs_mode="pixels")[0].obs_spec.shape == (20, 24, 6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_envs": 3}, "num_envs is 3 in the settings, but 4 in the environments."),
        ({"action_repeat": 2}, "action_repeat is 2 in the settings, but 1 in the environments."),
        ({"frame_stack": 1}, "frame_stack is 1 in the settings, but 2 in the environments."),
        ({"height": 20}, "height is 20 in the settings, but 18 in the environments."),
    ],
)
@pytest.mark.parametrize("name", ALGORITHMS)
def test_environments_that_are_not_those_of_the_settings_are_told(name, changes, message):
    kind = ALGORITHMS[name]
    config = kind.config_class(**settings_of(kind) | {"total_steps": 10_000_000})
    with pytest.raises(ValueError, match=re.escape(message)):
        kind(config.replace(**changes), ball_envs())


class Unhashable(VectorPixelEnv):
    __hash__ = None  # type: ignore[assignment]


@pytest.mark.parametrize(
    ("kind", "mode", "error"),
    [
        (VectorPixelEnv, "same_step", "must be 'next_step', got 'same_step'"),
        (Unhashable, "next_step", "environments must be hashable, got a Unhashable: make it"),
    ],
)
def test_environments_that_agents_cannot_use_are_refused(kind, mode, error):
    with pytest.raises((ValueError, TypeError), match=error):
        PPO(PPOConfig(**SMALL), kind(ball_envs().env, SMALL["num_envs"], mode))


def test_environments_come_with_their_parameters():
    with pytest.raises(
        ValueError, match="envs and env_params must be given together, got no env_params"
    ):
        make_train(PPOConfig(**SMALL), ball_envs())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_evals": 1.5}, "num_evals must be a whole number of at least 0, got 1.5"),
        ({"checkpoint_every": -1}, "checkpoint_every must be a whole number of at least 0, got -1"),
        ({"checkpoint_minutes": -1}, "checkpoint_minutes must be a number of at least 0, got -1"),
        ({"seed": 2**32 - 1, "seeds": 2}, "seeds must be below 2**32"),
        ({"resume": "last"}, "Did you mean 'latest'"),
        ({"progress": "no"}, "progress must be True or False, got 'no'"),
        ({"output_dir": None}, "output_dir must be a folder's path, got None"),
        ({"output_dir": ""}, "output_dir must be a folder's path, got ''"),
    ],
)
def test_options_of_a_run_out_of_range_are_told(settings, message):
    with pytest.raises((ValueError, TypeError), match=re.escape(message)):
        RunConfig(**settings)
