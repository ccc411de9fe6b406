"""What ``BraxPhysics`` promises about any Brax environment."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.io import mjcf

from pixelbrax_jax.physics.brax.engine import BraxPhysics, envs, training
from pixelbrax_jax.physics.brax.loading import load_brax_env
from pixelbrax_jax.physics.mujoco.compatibility import loading_silenced

SLIDER = """
<mujoco>
  <worldbody>
    <body name="puck"><joint name="x" type="slide" axis="1 0 0"/><geom size=".1"/></body>
  </worldbody>
  <actuator><motor joint="x" gear="1" ctrlrange="-1 1" ctrllimited="true"/></actuator>
</mujoco>
"""


class Slider(envs.PipelineEnv):
    """A puck on a rail that does everything a third party's environment might do."""

    def __init__(self, start=0.0, observe=None, extra_info=False, reward_shape=()):
        with loading_silenced():
            super().__init__(mjcf.loads(SLIDER), backend="spring", n_frames=2)
        self.start, self.observe, self.extra_info = start, observe, extra_info
        self.reward_shape = reward_shape

    def reset(self, rng):
        rng, draw = jax.random.split(rng)
        q = jax.random.uniform(draw, (1,)) * 0.1 + self.start
        pipeline = self.pipeline_init(q, jnp.zeros(1))
        zero = jnp.zeros(())
        return envs.State(
            pipeline,
            self._obs(pipeline),
            zero,
            zero,
            {"total": zero},
            {"key": rng, "steps": jnp.zeros((), jnp.int32), "nested": {"weak": 0.0}},
        )

    def step(self, state, action):
        pipeline = self.pipeline_step(state.pipeline_state, action)
        key, _ = jax.random.split(state.info["key"])
        # In place, as Brax's own environments do.
        state.metrics.update(total=state.metrics["total"] + 1)
        state.info.update(key=key, steps=state.info["steps"] + 1)
        state.info["nested"].update(weak=state.info["nested"]["weak"] + 1)
        if self.extra_info:
            state.info["new"] = 1.0
        return state.replace(
            pipeline_state=pipeline,
            obs=self._obs(pipeline),
            reward=jnp.full(self.reward_shape, 2.0) if self.reward_shape else 2,
            done=pipeline.q[0] > 1,
        )

    def _obs(self, pipeline):
        obs = jnp.concatenate([pipeline.q, pipeline.qd])
        return obs if self.observe is None else self.observe(obs)


@pytest.fixture(scope="module")
def slider(compiled):
    return compiled(BraxPhysics(Slider()))


def test_third_party_environment(slider):
    physics = slider.physics
    assert (physics.action_size, physics.state_size, physics.backend) == (1, 2, "spring")
    assert physics.link_names == ("puck",)
    first = slider.reset(jax.random.key(0))
    state = first
    for _ in range(3):
        state = slider.step(state, np.ones(1, np.float32))
    assert state.reward == 2
    assert state.obs[0] > first.obs[0]
    assert state.engine.metrics["total"] == 3
    assert state.engine.info["steps"] == 3
    assert state.engine.info["nested"]["weak"] == 3
    assert slider.traces == 1


def test_dicts_are_copied_before_brax_updates_them(slider):
    state = slider.reset(jax.random.key(0))
    metrics, info = dict(state.engine.metrics), dict(state.engine.info)
    with jax.disable_jit():
        jax.eval_shape(lambda: slider.physics.step(state, jnp.zeros(1)))
    assert state.engine.metrics == metrics
    assert state.engine.info["steps"] is info["steps"]
    assert state.engine.info["nested"]["weak"] == 0


def test_done_is_terminated(slider):
    state = slider.from_qpos(np.array([1.5], np.float32))
    assert not state.terminated
    state = slider.step(state, np.zeros(1, np.float32))
    assert state.terminated
    assert not state.non_finite


def test_raw_keys_of_brax_are_accepted(compiled):
    physics = BraxPhysics(Slider())
    typed = jax.jit(physics.reset)(jax.random.key(3))
    raw = jax.jit(physics.reset)(jax.random.PRNGKey(3))
    np.testing.assert_array_equal(typed.obs, raw.obs)


def test_non_finite_reset(compiled):
    program = compiled(BraxPhysics(Slider(start=np.nan)))
    state = program.reset(jax.random.key(0))
    for _ in range(2):
        assert state.non_finite
        assert state.terminated
        assert state.reward == 0
        np.testing.assert_array_equal(state.xpos, np.zeros((1, 3)))
        np.testing.assert_array_equal(state.xquat, [[1, 0, 0, 0]])
        np.testing.assert_array_equal(state.obs, np.zeros(2))
        state = program.step(state, np.zeros(1, np.float32))


@pytest.mark.parametrize("task", ["ant", "inverted_pendulum"])
def test_given_environment_is_left_alone(task):
    env = load_brax_env(task, "spring")
    fields = dict(vars(env))
    BraxPhysics(env, colors={"rail": (1, 0, 0)} if task == "inverted_pendulum" else None)
    assert vars(env).keys() == fields.keys()
    assert all(vars(env)[name] is value for name, value in fields.items())
    assert "pipeline_init" not in vars(env)


def test_harmless_wrapper(compiled):
    class Doubled(envs.Wrapper):
        def step(self, state, action):
            state = self.env.step(state, action)
            return state.replace(reward=state.reward * 2)

    env = Doubled(Slider())
    inner = env.env
    program = compiled(BraxPhysics(env))
    state = program.step(program.reset(jax.random.key(0)), np.zeros(1, np.float32))
    assert state.reward == 4
    assert env.env is inner


@pytest.mark.parametrize(
    "wrapped",
    [
        lambda: training.EpisodeWrapper(Slider(), 10, 1),
        lambda: training.AutoResetWrapper(training.VmapWrapper(Slider())),
    ],
)
def test_training_wrappers_are_refused(wrapped):
    env = wrapped()
    expected = f"wrapped in {type(env).__name__}; pass the bare one"
    with pytest.raises(ValueError, match=expected):
        BraxPhysics(env)


def test_environment_without_a_model():
    with pytest.raises(ValueError, match=r"Fast has no MuJoCo model in env\.sys\.mj_model"):
        BraxPhysics(envs.get_environment("fast"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observe": lambda obs: {"state": obs}}, r"must observe one flat array, got \{'state'"),
        ({"observe": lambda obs: obs[None]}, r"must observe one flat array, got \(1, 2\)"),
        ({"reward_shape": (3,)}, r"reward must be a scalar, got shape \(3,\)"),
        ({"extra_info": True}, "step changes the tree of the environment's state"),
    ],
)
def test_unfit_environments(options, message):
    with pytest.raises(ValueError, match=message):
        BraxPhysics(Slider(**options))


def test_wrong_action_shape(slider):
    state = slider.reset(jax.random.key(0))
    with pytest.raises(ValueError, match=r"action must have shape \(1,\), got \(2,\)"):
        slider.physics.step(state, np.zeros(2, np.float32))


QUIET = """
from pixelbrax_jax.registry import make_physics
import jax
import jax.numpy as jnp
for physics in make_physics("halfcheetah"), make_physics("reacher", backend="mjx"):
    state = jax.eval_shape(physics.reset, jax.random.key(0))
    jax.eval_shape(physics.step, state, jnp.zeros(physics.action_size))
"""


@pytest.mark.slow
def test_nothing_is_printed_logged_or_warned(tmp_path):
    """Half cheetah's deprecated setting would make MuJoCo write a log file here."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", QUIET],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    assert done.stderr == ""
    assert list(tmp_path.iterdir()) == []
