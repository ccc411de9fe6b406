"""What environments, adapters and agents give under flags of JAX, as digests of their arrays.

python -m tests.under_flags FLAGS PART [PART ...]

FLAGS is JSON, names of ``jax.config`` and values. A part is ``env:TASK`` (with distractors after a
comma, if any), ``gymnasium``, ``sb3``, ``torchrl`` or an algorithm. Digests are printed as JSON.
"""

import hashlib
import json
import sys
from functools import partial
from typing import Any

import jax
import numpy as np

SIZE = {"height": 16, "width": 16}
TASK = "inverted_pendulum"
NUM_STEPS = 3


def digest(tree: Any) -> str:
    """Digest of paths, dtypes, shapes and bytes of a tree's arrays."""
    found = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(jax.device_get(tree)):
        leaf = np.asarray(leaf)
        found.update(f"{path} {leaf.dtype} {leaf.shape}".encode() + leaf.tobytes())
    return found.hexdigest()[:16]


def outputs(timestep: Any) -> Any:
    return jax.device_get((timestep.obs, timestep.reward, timestep.terminated, timestep.info))


def play_env(name: str) -> dict[str, Any]:
    """An environment alone, rendered, twice in a vector, and both in programs of the caller's."""
    import pixelbrax_jax as pb

    task, *distractors = name.split(",")
    env, params = pb.make(task, **SIZE, distractors=tuple(distractors))
    params = jax.device_put(params)
    key = jax.random.key(jax.device_put(np.uint32(0)))
    actions = np.linspace(-0.5, 0.5, NUM_STEPS * 2 * env.action_size)
    # As a user has them: 64 bits under jax_enable_x64.
    actions = jax.device_put(actions.reshape(NUM_STEPS, 2, -1))
    state, first = env.reset(key, params)
    state, second = env.step(state, actions[0, 0], params)
    frame = env.render(state, params)
    found = {
        "single": outputs(first) + outputs(second),
        "render": (frame.r, frame.g, frame.b, frame.depth, frame.seg),
        "next": outputs(env.next_episode(state, params)[1]),
    }
    envs = pb.VectorPixelEnv(env, 2)

    def several(key: Any, actions: Any, params: Any) -> Any:
        state, _ = envs.reset(key, params)
        return jax.lax.scan(partial(step, params), state, actions)[1]

    def step(params: Any, state: Any, action: Any) -> Any:
        return envs.step(state, action, params)

    found["vector"] = outputs(jax.jit(several)(key, actions, params))
    return found


def play_gymnasium() -> dict[str, Any]:
    import gymnasium

    import pixelbrax_gym  # noqa: F401

    env = gymnasium.make("PixelBrax/InvertedPendulum-v0", render_mode="rgb_array", **SIZE)
    found = {"reset": env.reset(seed=0), "step": env.step(np.full(1, 0.5))}
    found["render"] = env.render()
    envs = gymnasium.make_vec("PixelBrax/InvertedPendulum-v0", num_envs=2, **SIZE)
    found["vector reset"] = envs.reset(seed=0)
    found["vector step"] = envs.step(np.full((2, 1), 0.5, np.float32))
    mask = np.array([True, False])
    options = {"reset_mask": mask}
    found["vector mask"] = envs.reset(seed=[3, None], options=options)
    return found


def play_sb3() -> dict[str, Any]:
    from pixelbrax_gym.sb3.vec_env import PixelBraxSB3VecEnv

    envs = PixelBraxSB3VecEnv(TASK, num_envs=2, **SIZE)
    envs.seed(0)
    found = {"reset": envs.reset()}
    obs, reward, done, infos = envs.step(np.full((2, 1), 0.5, np.float32))
    return found | {"step": (obs, reward, done), "infos": infos[0]["episode_return"] if "episode_return" in infos[0] else 0}


def play_torchrl() -> dict[str, Any]:
    from pixelbrax_gym.torchrl.env import PixelBraxTorchRLEnv

    import torch

    env = PixelBraxTorchRLEnv(TASK, num_envs=2, **SIZE)
    env.set_seed(0)
    td = env.reset()
    found = {"reset": td["pixels"].numpy()}
    td["action"] = torch.full((2, 1), 0.5)
    td = env.step(td)
    return found | {"step": (td["next", "pixels"].numpy(), td["next", "reward"].numpy())}


def train(name: str) -> dict[str, Any]:
    raise NotImplementedError


PLAYS = {"gymnasium": play_gymnasium, "sb3": play_sb3, "torchrl": play_torchrl}


def main(flags: str, *parts: str) -> None:
    for name, value in json.loads(flags).items():
        jax.config.update(name, value)
    found = {}
    for part in parts:
        kind, _, name = part.partition(":")
        results = play_env(name) if kind == "env" else PLAYS[kind]()
        found |= {f"{part} {name}": digest(result) for name, result in results.items()}
    print(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
