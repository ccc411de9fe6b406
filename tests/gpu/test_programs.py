"""What programs compute on an accelerator; run with `make test-gpu`."""

from __future__ import annotations

from contextlib import nullcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pixelbrax_jax as pb
from pixelbrax_gym.bench import throughput
from pixelbrax_jax.renderer import choice
from pixelbrax_jax.tasks import TASKS
from tests.gpu.processes import deterministic, told
from tests.renderer.interpreted import interpreted_kernel

pytestmark = pytest.mark.gpu

REPEATED = """
import hashlib, jax, jax.numpy as jnp, numpy as np
import pixelbrax_jax as pb
env, params = pb.make("ant", backend="spring", height=32, width=32)
envs = pb.VectorPixelEnv(env, 8)
state, timestep = envs.reset(jax.random.key(0), params)
step, digest = jax.jit(envs.step), hashlib.sha256()
for i in range(20):
    action = jax.random.uniform(jax.random.key(i), (8, env.action_size), minval=-1.0)
    state, timestep = step(state, action, params)
    for leaf in (timestep.obs, timestep.reward, state.sim.physics.obs):
        digest.update(np.asarray(leaf).tobytes())
print(digest.hexdigest())
"""


def test_runs_repeat_to_the_bit():
    one, other = (told(REPEATED, deterministic()) for _ in range(2))
    assert one == other


@pytest.mark.parametrize("shadows", [False, True], ids=["plain", "shadows"])
@pytest.mark.parametrize("task", TASKS)
def test_the_kernel_draws_what_the_plain_renderer_does(task, shadows, device):
    """At most one level apart on all but a thousandth of the pixels."""
    if device == "cpu" and (task != "inverted_pendulum" or shadows):
        pytest.skip("a CPU computes the kernel slowly; one task is enough there")
    size = 84 if device == "cuda" else 24
    frames = []
    with nullcontext() if device == "cuda" else interpreted_kernel():
        for renderer in ("pallas", "fused"):
            env, params = pb.make(task, renderer=renderer, shadows=shadows, height=size, width=size)
            states = throughput.first_states(env, params, 5)
            draw = jax.jit(jax.vmap(env.draw, in_axes=(0, None)))
            words = np.asarray(draw(states, params))
            frames.append(words[..., None].view(np.uint8).astype(int))
    apart = np.abs(frames[0] - frames[1]).max(-1)
    assert np.mean(apart <= 1) >= 0.999


def test_the_kernel_passes_its_check(device):
    if device != "cuda":
        pytest.skip("there is no NVIDIA GPU")
    assert choice.kernel_check().passed, choice.kernel_check().text


def test_a_step_of_the_device_is_that_of_a_cpu(device):
    """The forms that an accelerator has, batches and resets among them, agree with a CPU's."""
    task, num_steps = "inverted_pendulum", 30
    rewards = []
    for place in (jax.devices()[0], jax.devices("cpu")[0]):
        with jax.default_device(place):
            env, params = pb.make(task, backend="spring", height=24, width=24)
            params = params.replace(episode_length=np.int32(10))
            envs = pb.VectorPixelEnv(env, 4)
            state, _ = envs.reset(jax.random.key(0), params)
            total = []
            for _ in range(num_steps):
                state, timestep = envs.step(state, jnp.zeros((4, env.action_size)), params)
                total.append(np.asarray(timestep.reward))
            rewards.append(np.array(total))
    np.testing.assert_allclose(*rewards, rtol=1e-3, atol=1e-3)


@pytest.mark.timeout(900)
def test_steps_are_made_at_some_speed(device):
    """A smoke test, with no clock in the assertion but that of the benchmark."""
    num_envs = 1024 if device == "cuda" else 4
    found = throughput.scan("inverted_pendulum", num_envs)
    assert found["steps_per_second"] > 0
