"""What environments, adapters and agents give under flags of JAX, as digests.

python -m tests.under_flags FLAGS PART [PART ...]

FLAGS is JSON, names of ``jax.config`` and values. A part is
``env:TASK[,DISTRACTOR...][/RENDERER]``; ``program:`` of the same, compiled by nobody;
``gymnasium``, ``sb3``, ``torchrl``; or ``train:ALGORITHM``. Digests, or the errors instead, are
printed as JSON.
"""

import contextlib
import hashlib
import json
import sys
import tempfile
import traceback
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

SIZE = {"height": 16, "width": 16}
TASK = "inverted_pendulum"
NUM_STEPS = 3
KEY = jax.eval_shape(lambda: jax.random.key(0, impl="threefry2x32"))
_KERNEL = contextlib.ExitStack()
"""Keeps the kernel interpreted until the process ends."""


def digest(tree: Any) -> str:
    """Digest of paths, dtypes, shapes and bytes of a tree's arrays."""
    found = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(jax.device_get(tree)):
        leaf = np.asarray(leaf)
        found.update(f"{path} {leaf.dtype} {leaf.shape}".encode() + leaf.tobytes())
    return found.hexdigest()[:16]


def outputs(timestep: Any) -> Any:
    return jax.device_get((timestep.obs, timestep.reward, timestep.terminated, timestep.info))


def make(name: str) -> tuple[Any, Any]:
    """The environment of ``TASK[,DISTRACTOR...][/RENDERER]``."""
    import pixelbrax_jax as pb

    name, _, renderer = name.partition("/")
    if renderer == "pallas":
        from tests.renderer.interpreted import interpreted_kernel

        _KERNEL.enter_context(interpreted_kernel())
    task, *distractors = name.split(",")
    options = SIZE | {"distractors": tuple(distractors), "renderer": renderer or "auto"}
    if any("video" in link or "dcs" in link for link in distractors):
        options["clips"] = "procedural"
    return pb.make(task, **options)


def play_env(name: str) -> dict[str, Any]:
    """An environment alone, rendered, twice in a vector, and both in programs of the caller's."""
    import pixelbrax_jax as pb

    env, params = make(name)
    params = jax.device_put(params)
    key = jax.jit(jax.random.key)(jax.device_put(np.uint32(0)))
    actions = np.linspace(-0.5, 0.5, NUM_STEPS * 2 * env.action_size)
    # As a user has them: 64 bits under jax_enable_x64.
    actions = actions.reshape(NUM_STEPS, 2, -1)
    action, actions = jax.device_put((actions[0, 0], actions))
    state, first = env.reset(key, params)
    state, second = env.step(state, action, params)
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


def lower_env(name: str) -> dict[str, Any]:
    """The programs of two environments as they are lowered.

    JAX gives counters of loops 64 bits if it may; they are no part of what is compared.
    """
    import pixelbrax_jax as pb

    env, params = make(name)
    envs = pb.VectorPixelEnv(env, 2)
    state, _ = jax.eval_shape(envs.reset, KEY, params)
    action = jax.ShapeDtypeStruct((2, env.action_size), np.float32)
    lowered = {
        "reset": type(envs).reset.lower(envs, KEY, params),
        "step": type(envs).step.lower(envs, state, action, params),
    }
    return {name: one.as_text().replace("i64", "i32") for name, one in lowered.items()}


def play_gymnasium() -> dict[str, Any]:
    import gymnasium

    import pixelbrax_gym  # noqa: F401

    env = gymnasium.make("PixelBrax/InvertedPendulum-v0", render_mode="rgb_array", **SIZE)
    found = {"reset": env.reset(seed=0), "step": env.step(np.full(1, 0.5))}
    found["render"] = env.render()
    state = env.unwrapped.get_state()
    env.step(np.full(1, 0.5))
    found["state"] = env.reset(options={"state": state})
    single = env.unwrapped._stateful
    key = jax.jit(jax.random.key)(jax.device_put(np.uint32(0)))
    pose = jax.device_put(np.array([0.1, 0.2]))
    found["from_qpos"] = outputs(single.env.from_qpos(pose, None, key, single.params)[1])
    envs = gymnasium.make_vec("PixelBrax/InvertedPendulum-v0", num_envs=2, **SIZE)
    found["vector reset"] = envs.reset(seed=0)
    found["vector step"] = envs.step(np.full((2, 1), 0.5, np.float32))
    mask = np.array([True, False])
    options = {"reset_mask": mask}
    found["vector mask"] = envs.reset(seed=[3, None], options=options)
    return found


def play_sb3() -> dict[str, Any]:
    from pixelbrax_gym.sb3.vec_env import SB3VecEnv

    envs = SB3VecEnv(TASK, num_envs=2, **SIZE)
    envs.seed(0)
    found = {"reset": envs.reset()}
    obs, reward, done, _ = envs.step(np.full((2, 1), 0.5, np.float32))
    return found | {"step": (obs, reward, done)}


def play_torchrl() -> dict[str, Any]:
    import torch

    from pixelbrax_gym.torchrl.env import TorchRLEnv

    env = TorchRLEnv(TASK, num_envs=2, **SIZE)
    env.set_seed(0)
    td = env.reset()
    found = {"reset": td["pixels"].numpy()}
    td["action"] = torch.full((2, 1), 0.5)
    td = env.step(td)
    return found | {"step": (td["next", "pixels"].numpy(), td["next", "reward"].numpy())}


PHASIC = {"num-minibatches": 2, "num-policy-phases": 2, "aux-minibatches": 2}
OWN_OPTIONS = {
    "ppo": {"num-minibatches": 2},
    "ppg": PHASIC,
    "dcpg": PHASIC,
    "drqv2": {"replay-ratio": 0.25, "learning-starts": 8, "batch-size": 4, "buffer-size": 16},
}


def train(name: str) -> dict[str, Any]:
    """``pixelbrax train``, and the policy that it leaves."""
    from pixelbrax_gym.cli import main as pixelbrax
    from pixelbrax_jax.policy import load_policy

    with tempfile.TemporaryDirectory() as folder:
        options = {
            **{"task": TASK, "height": 18, "width": 18, "frame-stack": 1, "encoder": "small"},
            **{"num-envs": 2, "num-steps": 4, "total-steps": 16},
            **{"num-evals": 1, "eval-episodes": 2, "episode-length": 6, "output-dir": folder},
            **OWN_OPTIONS[name],
        }
        words = [word for pair in options.items() for word in (f"--{pair[0]}", str(pair[1]))]
        with contextlib.redirect_stdout(sys.stderr):
            status = pixelbrax(["train", name, *words, "--no-progress"])
        assert status == 0, f"exit status {status}"
        lines = (Path(folder) / "metrics.jsonl").read_text("utf-8").splitlines()
        measured = [json.loads(line) for line in lines]
        # What a clock says.
        for record in measured:
            for name in ("seconds", "speed/steps_per_second"):
                record.pop(name, None)
        pixels = jax.device_put(np.full((2, 18, 18, 3), 100, np.uint8))
        action = load_policy(Path(folder) / "policy.jax")(pixels)
    return {"metrics": measured, "policy": action}


PLAYS = {"env": play_env, "program": lower_env, "train": train}
PLAYS |= {"gymnasium": play_gymnasium, "sb3": play_sb3, "torchrl": play_torchrl}


def play(part: str) -> dict[str, str]:
    """Digests of a part."""
    kind, *name = part.split(":")
    return {f"{part} {name}": digest(result) for name, result in PLAYS[kind](*name).items()}


def main(flags: str, *parts: str) -> None:
    for name, value in json.loads(flags).items():
        jax.config.update(name, value)
    found = {}
    for part in parts:
        try:
            found |= play(part)
        except Exception as error:
            traceback.print_exc()
            found[part] = f"{type(error).__name__}: {error}"
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
