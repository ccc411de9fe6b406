"""Environments with the interface of MuJoCo Playground; the package itself is a client."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from flax import struct

import pixelbrax_jax as pb
from pixelbrax_jax.physics.mujoco.compatibility import import_silenced
from pixelbrax_jax.physics.mujoco.playground import playground_physics
from tests.envs.toy import Ball

with import_silenced():
    from mujoco import mjx

SLIDER = """
<mujoco>
  <option timestep=".01"/>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="aside" pos="0 -2 0" xyaxes="1 0 0 0 0 1"/>
    <camera name="beside" pos="0 -2 0" xyaxes="1 0 0 0 0 1" mode="trackcom"/>
    <body name="block">
      <joint type="slide" axis="1 0 0"/>
      <geom name="block" type="box" size=".1 .1 .1"/>
      <body pos="0 0 .3"><geom name="ball" size=".1"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="" gear="90"/></actuator>
</mujoco>
""".replace('joint type="slide"', 'joint name="x" type="slide"').replace('joint=""', 'joint="x"')


@struct.dataclass
class State:
    data: Any
    obs: Any
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, Any]
    info: dict[str, Any]


class Slider:
    """Ends beyond 35 mm; writes numbers of Python into its state, as Playground's do."""

    dt, action_size = 0.02, 1

    def __init__(self, impl="jax", **config):
        self.mj_model = mujoco.MjModel.from_xml_string(SLIDER)
        model = mjx.put_model(self.mj_model, impl="jax")
        self.mjx_model = (
            model if impl == "jax" else SimpleNamespace(impl=SimpleNamespace(value=impl))
        )
        self._config = config

    def reset(self, rng):
        x = 0.1 * jax.random.normal(rng, (1,))
        data = mjx.forward(self.mjx_model, mjx.make_data(self.mj_model, impl="jax").replace(qpos=x))
        return State(data, self.obs(data), 0.0, 0.0, {"x": jnp.zeros(())}, {"rng": rng, "steps": 0})

    def step(self, state, action):
        data = state.data.replace(ctrl=action)
        for _ in range(2):
            data = mjx.step(self.mjx_model, data)
        info = state.info | {"steps": state.info["steps"] + 1}
        done = (jnp.abs(data.qpos[0]) > 0.035).astype(float)
        return state.replace(
            data=data, obs=self.obs(data), reward=-(data.qpos[0] ** 2), done=done, info=info
        )

    def obs(self, data):
        return {"state": jnp.concatenate([data.qpos, data.qvel]), "privileged_state": data.ctrl}


@pytest.fixture(scope="module")
def physics():
    return playground_physics(Slider(episode_length=7))


def test_facts(physics):
    assert physics.link_names == ("block", "link/1", "camera/com")
    assert (physics.dt, physics.action_size, physics.state_size) == (0.02, 1, 2)
    assert physics.geoms.name == ("block", "ball")
    assert sorted(physics.rigs) == ["aside", "beside"]
    assert physics.time_limit == 7


def test_episodes_are_the_environments(physics):
    env, key = Slider(), jax.random.key(2)
    actions = jnp.linspace(-1, 1, 12)[:, None]

    def ours(key):
        def step(state, action):
            state = physics.step(state, action)
            return state, (state.obs, state.reward, state.terminated, state.xpos)

        return jax.lax.scan(step, physics.reset(key), actions)[1]

    @jax.jit
    def theirs(key):
        def step(state, action):
            state = env.step(state, action)
            return state, (state.obs["state"], state.reward, state.done > 0.5)

        first = env.reset(jax.random.key_data(key))
        first = jax.tree.map(jnp.asarray, first.replace(reward=jnp.zeros(()), done=jnp.zeros(())))
        return jax.lax.scan(step, first, actions)[1]

    *found, xpos = jax.jit(ours)(key)
    for one, other in zip(found, theirs(key), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-6)
    assert len(np.unique(found[2])) == 2, "it ends, not at once"
    # Poses fit the joint positions.
    np.testing.assert_allclose(xpos[:, 0, 0], found[0][:, 0], atol=1e-6)
    model = env.mj_model
    heights = model.body_mass[1:] @ [0.0, 0.3] / model.body_mass.sum()
    np.testing.assert_allclose(xpos[:, 2, 2], heights, atol=1e-6)


@pytest.mark.slow
def test_it_is_a_task_like_others(physics):
    pb.register("own_slider", lambda: physics)
    env, params = pb.make("own_slider", height=16, width=16, obs_mode="both", camera="aside")
    assert params.episode_length == 7
    pb.check_env(env, params)


def test_what_is_no_environment():
    with pytest.raises(ValueError, match=r"got a Ball, which has no mj_model"):
        playground_physics(Ball())
    with pytest.raises(ValueError, match=r"impl='warp', which needs MuJoCo Warp: load it with"):
        playground_physics(Slider(impl="warp"))


def test_without_the_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_playground", None)
    with pytest.raises(ImportError, match="try: pip install playground"):
        playground_physics("CartpoleBalance")
