"""A pixel environment as Brax's trainers see it: numbers, ends of episodes, training itself."""

from __future__ import annotations

import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax import EnvParams, PixelEnv, VectorPixelEnv
from pixelbrax_jax.envs.brax_env import PIXELS, BraxEnv, wrap_fresh_episodes
from pixelbrax_jax.physics.brax.engine import training
from pixelbrax_jax.physics.mujoco.compatibility import accept_device_put_replicated
from tests.envs.toy import PARAMS, Ball, limited

RIGHT = jnp.ones(1)
# Five balls; the first three run until they leave, the others rest until time is up.
ACTIONS = jnp.array([1.0, 1.0, 1.0, 0.0, 0.0])[:, None]
NUM_ENVS = len(ACTIONS)
WRAPS = [training.wrap, wrap_fresh_episodes]


def make(**options) -> PixelEnv:
    return PixelEnv(Ball(), **({"height": 16, "width": 16, "frame_stack": 2} | options))


def make_brax(**options) -> BraxEnv:
    return BraxEnv(make(**options), PARAMS)


def keys(num_envs: int = NUM_ENVS) -> jax.Array:
    """Raw keys, as Brax's trainers hand them out."""
    return jax.random.split(jax.random.PRNGKey(0), num_envs)


def unit(pixels: jax.Array) -> np.ndarray:
    """uint8 colors as float32 in [0, 1]."""
    return np.asarray(pixels, np.float32) * np.float32(1 / 255)


def test_colors_are_in_the_unit_interval():
    levels = jnp.arange(256, dtype=jnp.uint8)
    seen = np.asarray(jax.jit(make_brax().observation)(levels)[PIXELS])
    assert (seen[0], seen[-1]) == (0, 1)
    np.testing.assert_array_equal(seen, unit(levels))
    np.testing.assert_allclose(seen, np.arange(256) / 255, rtol=1.2e-7)  # one step of float32


def describe(tree) -> list[tuple]:
    """All of a tree that a scan wants to stay the same, and a compiled program besides."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return [(jax.tree_util.keystr(path), x.shape, x.dtype, x.weak_type) for path, x in leaves]


@pytest.mark.parametrize("obs_mode", ["pixels", "state", "both"])
def test_numbers_are_those_of_the_pixel_environment(obs_mode):
    pixel, brax = make(obs_mode=obs_mode), make_brax(obs_mode=obs_mode)
    state, timestep = pixel.reset(jax.random.key(3), PARAMS)
    seen = brax.reset(jax.random.key(3))
    for action in (0 * RIGHT, RIGHT, 0.5 * RIGHT, jnp.nan * RIGHT, None):
        np.testing.assert_array_equal(seen.reward, timestep.reward)
        np.testing.assert_array_equal(seen.done, timestep.terminated)
        np.testing.assert_array_equal(seen.metrics["non_finite"], timestep.info["non_finite"])
        if obs_mode == "state":
            np.testing.assert_array_equal(seen.obs, timestep.obs)
        else:
            pixels = timestep.obs["pixels"] if obs_mode == "both" else timestep.obs
            np.testing.assert_array_equal(seen.obs[PIXELS], unit(pixels))
        if obs_mode == "both":
            np.testing.assert_array_equal(seen.obs["state"], timestep.obs["state"])
        if action is not None:
            state, timestep = pixel.step(state, action, PARAMS)
            seen = brax.step(seen, action)
    assert seen.done == 1
    assert seen.metrics["non_finite"] == 1


def test_sizes_are_those_of_the_observation():
    for mode in ("pixels", "both"):
        env = make_brax(obs_mode=mode, height=12)
        shapes = jax.eval_shape(env.reset, jax.random.key(0)).obs
        assert env.observation_size == {name: shape.shape for name, shape in shapes.items()}
        assert env.observation_size[PIXELS] == (12, 16, 6)
        assert shapes[PIXELS].dtype == jnp.float32
    env = make_brax(obs_mode="state", action_repeat=3)
    assert (env.observation_size, env.action_size, env.backend) == (2, 1, "toy")
    assert env.dt == pytest.approx(0.3)
    assert env.unwrapped is env


def test_depth_is_not_for_braxs_networks():
    with pytest.raises(ValueError, match="is not for Brax's trainers, whose images"):
        make_brax(obs_mode="pixels+depth")
    with pytest.raises(ValueError, match="trainers, whose cameras share height and width: leave"):
        make_brax(num_cameras=2, camera_sizes={"front": (36, 36), "top": (24, 24)})


def test_a_raw_key_means_the_typed_one():
    env = make_brax(obs_mode="state")
    raw, typed = jax.random.PRNGKey(7), jax.random.key(7)
    np.testing.assert_array_equal(env.reset(raw).obs, env.reset(typed).obs)
    with pytest.raises(TypeError, match="key must have shape"):
        env.reset(keys(2))
    with pytest.raises(TypeError, match="key must come from"):
        env.reset(0)


@pytest.mark.parametrize("obs_mode", ["pixels", "state", "both"])
@pytest.mark.parametrize("wrap", WRAPS)
def test_a_state_keeps_its_structure(obs_mode, wrap):
    bare = make_brax(obs_mode=obs_mode)
    first = jax.eval_shape(bare.reset, jax.random.key(0))
    assert describe(jax.eval_shape(bare.step, first, RIGHT)) == describe(first)
    # Brax's evaluation adds metrics and info of its own.
    env = training.EvalWrapper(wrap(bare, episode_length=3))
    first = jax.eval_shape(env.reset, keys())
    after = jax.eval_shape(env.step, first, ACTIONS)
    assert describe(after) == describe(first)
    assert jax.tree.structure(after) == jax.tree.structure(first)


def brax_rollout(env, num_steps: int):
    """The first states, and (T, N) states after them."""

    @jax.jit
    def run():
        def step(state, _):
            state = env.step(state, ACTIONS)
            return state, state

        first = env.reset(keys())
        return first, jax.lax.scan(step, first, length=num_steps)[1]

    return run()


def pixel_rollout(env: PixelEnv, num_steps: int, params: EnvParams):
    """(T, N) timesteps of the same environments under Gymnasium's same-step autoreset."""
    envs = VectorPixelEnv(env, NUM_ENVS, "same_step")

    def step(state, _):
        return envs.step(state, ACTIONS, params)

    state, _ = envs.reset(jax.random.wrap_key_data(keys()), params)
    return jax.lax.scan(step, state, length=num_steps)[1]


def ends(timesteps) -> np.ndarray:
    return np.asarray(timesteps.terminated | timesteps.truncated)


@pytest.fixture(scope="module")
def limit() -> int:
    """A time limit that one ball reaches just as it leaves, two before, and two by resting."""
    terminated = np.asarray(pixel_rollout(make(obs_mode="state"), 30, limited(1000)).terminated)
    lengths = np.argmax(terminated, axis=0)[:3] + 1
    assert sorted(lengths)[1] < max(lengths)
    return int(max(lengths))


def test_fresh_episodes_are_those_of_same_step_autoreset(limit):
    """Observations, rewards, termination, truncation, what is summed: at every step."""
    wrapped = wrap_fresh_episodes(make_brax(obs_mode="both"), episode_length=limit)
    _, states = brax_rollout(wrapped, 3 * limit)
    expected = pixel_rollout(make(obs_mode="both"), 3 * limit, limited(limit))
    ended = ends(expected)
    assert (ended.sum(axis=0) >= 3).all()
    assert expected.terminated[limit - 1].any()
    assert expected.truncated[limit - 1].any()

    np.testing.assert_array_equal(states.done, ended)
    np.testing.assert_array_equal(states.info["truncation"], expected.truncated)
    np.testing.assert_array_equal(states.reward, expected.reward)
    np.testing.assert_array_equal(states.obs["state"], expected.obs["state"])
    # Programs differ in rounding: a level.
    difference = np.abs(states.obs[PIXELS] - unit(expected.obs["pixels"]))
    assert difference.max() < 1.5 / 255
    assert np.mean(difference > 0) < 1e-4
    final, sums = expected.info["final_info"], states.info["episode_metrics"]
    np.testing.assert_array_equal(sums["length"][ended], final["episode_length"][ended])
    # The same sum in the same order.
    np.testing.assert_array_equal(sums["sum_reward"][ended], final["episode_return"][ended])


def test_the_time_limit_is_braxs_alone():
    env = BraxEnv(make(obs_mode="state", action_repeat=2), limited(5))
    assert env.episode_length == 3  # calls, of which the last would have been cut short
    state = env.reset(jax.random.key(0))
    for _ in range(6):
        state = env.step(state, 0 * RIGHT)
        assert state.done == 0
    # Beyond its own limit the pixel environment would repeat no action.
    assert state.pipeline_state.sim.step_count == 12


def test_brax_randomises_the_parameters():
    def repaint(sys, rng):
        """As a user of Brax writes one: the randomised parameters, and which they are."""
        rgb = jax.vmap(lambda key: jax.random.uniform(key, sys.geoms.rgb.shape))(rng)
        axes = jax.tree.map(lambda _: None, sys)
        randomised = sys.replace(geoms=sys.geoms.replace(rgb=rgb))
        return randomised, axes.replace(geoms=axes.geoms.replace(rgb=0))

    env, pixel = make_brax(), make()
    sys = env.sys
    wrapped = training.wrap(
        env, episode_length=9, randomization_fn=functools.partial(repaint, rng=keys())
    )
    _, states = brax_rollout(wrapped, 2)
    painted, _ = repaint(PARAMS, keys())
    for i in range(NUM_ENVS):
        params = PARAMS.replace(geoms=PARAMS.geoms.replace(rgb=painted.geoms.rgb[i]))
        state, _ = pixel.reset(jax.random.wrap_key_data(keys()[i]), params)
        for t in range(2):
            state, timestep = pixel.step(state, ACTIONS[i], params)
            np.testing.assert_array_equal(states.obs[PIXELS][t, i], unit(timestep.obs))
    assert env.sys is sys  # nothing of the trace stays behind


def test_what_does_not_fit_is_told():
    env = make_brax()
    with pytest.raises(TypeError, match="env must be a PixelEnv, got BraxEnv"):
        BraxEnv(env, PARAMS)
    with pytest.raises(TypeError, match="bare BraxEnv, got VmapWrapper"):
        wrap_fresh_episodes(training.VmapWrapper(env))
    with pytest.raises(ValueError, match="leave out randomization_fn"):
        wrap_fresh_episodes(env, randomization_fn=lambda sys, rng: (sys, None))


def test_the_lost_function_of_jax_replicates():
    module = types.ModuleType("module")
    module.jax = jax
    accept_device_put_replicated(module)
    accept_device_put_replicated(module)  # again: changes nothing
    assert module.jax.numpy is jnp
    assert module.jax.device_put_replicated is not None
    tree = {"count": 3, "key": jax.random.key(0), "weights": jnp.arange(6.0).reshape(2, 3)}
    devices = jax.local_devices()[:1]
    rows = module.jax.device_put_replicated(tree, devices)
    for name, shape in (("count", ()), ("key", ()), ("weights", (2, 3))):
        assert rows[name].shape == (1, *shape)
        assert rows[name].devices() == set(devices)
    # What Brax's trainers do with it.
    np.testing.assert_array_equal(
        jax.pmap(lambda x: 2 * x)(rows["weights"])[0], 2 * tree["weights"]
    )


@pytest.mark.slow
def test_ppo_trains_from_pixels_and_goes_on_from_a_checkpoint(tmp_path):
    # Brax warns when it is imported before PixelBrax, which knows the warning.
    from brax.training.agents.ppo import networks_vision
    from brax.training.agents.ppo import train as ppo

    seen, told = [], []
    train = functools.partial(
        ppo.train,
        make_brax(),
        num_envs=8,
        episode_length=20,
        unroll_length=5,
        batch_size=8,
        num_minibatches=2,
        num_updates_per_batch=1,
        num_eval_envs=1,
        num_evals=0,
        vision=True,
        normalize_observations=True,
        augment_pixels=True,
        log_training_metrics=True,
        network_factory=functools.partial(
            networks_vision.make_ppo_networks_vision,
            policy_hidden_layer_sizes=(16,),
            value_hidden_layer_sizes=(16,),
            cnn_output_channels=(8,),
            cnn_kernel_size=(4,),
            cnn_stride=(2,),
        ),
        progress_fn=lambda steps, metrics: seen.append((steps, metrics)),
        policy_params_fn=lambda steps, make_policy, params: told.append((steps, params)),
    )
    _, trained, _ = train(num_timesteps=800, save_checkpoint_path=str(tmp_path))
    assert [steps for steps, _ in seen] == list(range(80, 801, 80))
    metrics = seen[-1][1]
    assert 10 < metrics["episode/length"] <= 20
    assert metrics["episode/non_finite"] == 0
    # A ball stays within -0.5 - 20 * 0.1 and 1.1; its reward is where it is.
    assert -50 < metrics["episode/sum_reward"] < 22
    assert all(np.isfinite(value) for value in metrics.values())
    initial = told[0][1]
    assert not trees_equal(initial[1], trained[1])

    seen.clear()
    told.clear()
    train(
        num_timesteps=800,
        restore_checkpoint_path=str(tmp_path / "000000000800"),
        wrap_env_fn=wrap_fresh_episodes,
    )
    assert 10 < seen[-1][1]["episode/length"] <= 20
    (_, restored), (_, later) = told
    assert trees_equal(restored[1:], trained[1:])
    assert not trees_equal(later[1], trained[1])


def trees_equal(a, b) -> bool:
    return all(map(np.array_equal, jax.tree.leaves(a), jax.tree.leaves(b)))
