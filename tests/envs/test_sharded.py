"""Environments over two devices are those of one device, half on each; compiled as users do."""

from __future__ import annotations

import json

import pytest

from tests.two_devices import run_on_two_devices

SCRIPT = """
import json, re, sys
import jax, numpy as np
import pixelbrax_jax as pb
from pixelbrax_jax.envs.sharded import ShardedVectorEnv, make_env_mesh

from tests.envs.toy import PARAMS, Ball

if sys.argv[1] == "toy":
    env, params = pb.PixelEnv(Ball(), height=16, width=16, frame_stack=2, obs_mode="both"), PARAMS
else:
    env, params = pb.make(sys.argv[1], height=16, width=16, frame_stack=2, obs_mode="both")
NUM_ENVS = 4
# Rows of parameters go where their environments are.
params = params.replace(episode_length=np.arange(NUM_ENVS, dtype=np.int32) % 5 + 3)
actions = jax.random.uniform(jax.random.key(1), (8, NUM_ENVS, 1), minval=-1.0, maxval=1.0)

def rollout(venv):
    state, timestep = venv.reset(jax.random.key(0), params)
    steps, program = [timestep], jax.jit(venv.step).lower(state, actions[0], params).compile()
    for action in actions:
        state, timestep = program(state, action, params)
        steps.append(timestep)
    return state, steps, program.as_text()

state, steps, text = rollout(ShardedVectorEnv(env, NUM_ENVS, make_env_mesh(2)))
_, alone, _ = rollout(pb.VectorPixelEnv(env, NUM_ENVS))
bytes_of = lambda tree, size: sum(size(leaf) for leaf in jax.tree.leaves(tree))
far = max(
    float(np.abs(np.asarray(a.obs["state"]) - np.asarray(b.obs["state"])).max())
    for a, b in zip(steps, alone)
)
pixels = [np.asarray(s.obs["pixels"]).astype(int) for s in steps]
others = [np.asarray(s.obs["pixels"]).astype(int) for s in alone]
print(json.dumps({
    "devices": jax.device_count(),
    "far": far,
    "pixels_that_differ": float(np.mean([a != b for a, b in zip(pixels, others)])),
    "flags": all(bool((np.asarray(x) == np.asarray(y)).all()) for a, b in zip(steps, alone)
                 for x, y in ((a.terminated, b.terminated), (a.truncated, b.truncated))),
    "truncated": sum(int(np.asarray(a.truncated).sum()) for a in steps),
    "ended": sum(int(np.asarray(a.truncated | a.terminated).sum()) for a in steps),
    "all_bytes": bytes_of((state, steps[-1]), lambda leaf: leaf.nbytes),
    "bytes_of_one": bytes_of((state, steps[-1]),
                             lambda leaf: leaf.addressable_shards[0].data.nbytes),
    "collectives": re.findall(r"all-reduce|all-gather|all-to-all|collective-permute", text),
}))
"""


@pytest.fixture(
    scope="module", params=["toy", pytest.param("inverted_pendulum", marks=pytest.mark.slow)]
)
def told(request):
    return json.loads(run_on_two_devices(SCRIPT, request.param).strip().splitlines()[-1])


def test_environments_are_the_same(told):
    assert told["devices"] == 2
    assert told["flags"]
    # Each of them, most by the limit of its own.
    assert told["ended"] >= 4
    assert told["truncated"] > 2
    assert told["far"] < 1e-4
    assert told["pixels_that_differ"] < 0.01


def test_each_device_holds_its_own_and_asks_nobody(told):
    assert told["bytes_of_one"] * 2 == told["all_bytes"]
    assert told["collectives"] == []
