"""Killed runs, several devices, several processes: each in processes of its own."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

ROOT = Path(__file__).parents[2]
MINIBATCHES = "--num-minibatches 2"
PHASIC = f"{MINIBATCHES} --num-policy-phases 3 --aux-minibatches 3 --aux-epochs 1"
REPLAY = (
    "--replay-ratio 0.125 --buffer-size 256 --learning-starts 64 --batch-size 8 --hidden-dim 16 "
    "--checkpoint-replay"
)
EXTRA = {
    "ppo": f"{MINIBATCHES} --update-epochs 1",
    "ppg": PHASIC,
    "dcpg": PHASIC,
    "drqv2": REPLAY,
}
TINY = (
    "--task inverted_pendulum --height 18 --width 18 --frame-stack 2 --encoder small --num-envs 4 "
    "--num-steps 8 --no-progress"
)
PER_ITERATION = 32
AS_USERS = {"XLA_FLAGS": ""}
"""What is compared is compiled alike, and not as the other tests are, with more rounding."""
FOUR_DEVICES = {"XLA_FLAGS": "--xla_force_host_platform_device_count=4"}


def command(algorithm: str, folder: Path, options: str) -> list[str]:
    return [
        *(sys.executable, "-m", "pixelbrax_gym.cli", "train", algorithm),
        *f"{TINY} {EXTRA[algorithm]} {options}".split(),
        *("--output-dir", str(folder)),
    ]


def finish(*arguments, **environ) -> None:
    process = subprocess.run(
        command(*arguments), cwd=ROOT, env=os.environ | environ, capture_output=True, text=True
    )
    assert process.returncode == 0, process.stderr


def leaves(folder: Path, steps: int) -> dict[str, np.ndarray]:
    """All arrays of a checkpoint, by name."""
    import orbax.checkpoint as ocp

    reader = ocp.Checkpointer(ocp.PyTreeCheckpointHandler())
    path = folder / "checkpoints" / str(steps) / "state"
    names = reader.metadata(path).item_metadata.tree
    as_numpy = {name: ocp.RestoreArgs(restore_type=np.ndarray) for name in names}
    return reader.restore(path, args=ocp.args.PyTreeRestore(restore_args=as_numpy))


def assert_equal(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    assert one.keys() == other.keys()
    for name, leaf in one.items():
        np.testing.assert_array_equal(leaf, other[name], err_msg=name)


def assert_networks_are_close(one: Path, other: Path, steps: int) -> None:
    """Those of the checkpoints of two runs, up to rounding."""
    found, expected = leaves(one, steps), leaves(other, steps)
    assert found.keys() == expected.keys()
    for name in (name for name in found if name.startswith("networks.")):
        np.testing.assert_allclose(found[name], expected[name], 1e-4, 1e-5, err_msg=name)


@pytest.mark.parametrize("algorithm", EXTRA)
def test_a_killed_run_ends_as_one_that_never_was(algorithm, tmp_path):
    """Killed mid rollout, within the buffer, and while a checkpoint is written."""
    iterations = 60
    options = f"--total-steps {iterations * PER_ITERATION} --checkpoint-every {PER_ITERATION}"
    finish(algorithm, tmp_path / "whole", options)
    killed = tmp_path / "killed"
    # At a checkpoint of every iteration, any moment is close to one of the three.
    for least in (4, 14, 29):
        line = command(algorithm, killed, f"{options} --resume latest")
        process = subprocess.Popen(line, cwd=ROOT, stderr=subprocess.DEVNULL)
        end = time.monotonic() + 200
        while process.poll() is None:
            assert time.monotonic() < end, "no checkpoint came"
            # A folder under a temporary name is a checkpoint that is being written.
            names = [path.name for path in (killed / "checkpoints").glob("*")]
            written = [int(name) // PER_ITERATION for name in names if name.isdigit()]
            if max(written, default=0) >= least and (
                least != 14 or any("tmp" in name for name in names)
            ):
                break
            time.sleep(0.002)
        assert process.poll() is None, "the run was over before it could be killed"
        process.send_signal(signal.SIGKILL)
        process.wait()
    finish(algorithm, killed, f"{options} --resume latest")
    last = iterations * PER_ITERATION
    assert_equal(leaves(killed, last), leaves(tmp_path / "whole", last))


@pytest.mark.parametrize("algorithm", EXTRA)
def test_four_devices_learn_what_one_learns(algorithm, tmp_path):
    options = f"--total-steps {4 * PER_ITERATION}"
    finish(algorithm, tmp_path / "one", options, **AS_USERS)
    finish(algorithm, tmp_path / "four", options, **FOUR_DEVICES)
    assert_networks_are_close(tmp_path / "four", tmp_path / "one", 4 * PER_ITERATION)


def test_a_run_on_four_devices_goes_on_to_the_bit(tmp_path):
    line = f"--total-steps {5 * PER_ITERATION}"
    finish("ppg", tmp_path / "whole", line, **FOUR_DEVICES)
    line = f"--total-steps {4 * PER_ITERATION} --cpu-devices 4"
    finish("ppg", tmp_path / "parts", line, **AS_USERS)
    line = f"--total-steps {5 * PER_ITERATION} --cpu-devices 4 --resume latest"
    finish("ppg", tmp_path / "parts", line, **AS_USERS)
    parts, whole = (leaves(tmp_path / name, 5 * PER_ITERATION) for name in ("parts", "whole"))
    assert_equal(parts, whole)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        (
            "ppg",
            {"num_minibatches": 2, "num_policy_phases": 2, "aux_minibatches": 4},
        ),
        (
            "drqv2",
            {"replay_ratio": 0.125, "buffer_size": 128, "learning_starts": 64, "batch_size": 16},
        ),
    ],
)
def test_frames_stay_on_their_devices(name, settings):
    """What devices tell each other is gradients, not frames."""
    code = r"""
import jax, json, re, sys
from pixelbrax_jax.agents.config import make_env
from pixelbrax_jax.agents.registry import ALGORITHMS
from pixelbrax_jax.agents.runner.devices import replicate, state_shardings
from pixelbrax_jax.config import EnvConfig
from pixelbrax_jax.envs.sharded import ShardedVectorEnv, make_env_mesh

kind = ALGORITHMS[sys.argv[1]]
config = kind.config_class(
    env=EnvConfig(task="inverted_pendulum", height=18, width=18, frame_stack=2),
    encoder="small", num_envs=8, num_steps=8,
    total_steps=1024, random_shift=1, **json.loads(sys.argv[2]),
)
env, params = make_env(config)
mesh = make_env_mesh()
algorithm = kind(config, ShardedVectorEnv(env, config.num_envs, mesh))
params = replicate(mesh, params)
template = jax.eval_shape(algorithm.init, jax.random.key(0), params)
shardings = state_shardings(mesh, template)
state = jax.tree.map(
    lambda leaf, sharding: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding),
    template, shardings,
)
jobs = [(algorithm.iterate, (state, params))]
if algorithm.auxiliary_every:
    jobs.append((algorithm.auxiliary, (state,)))
for job, arguments in jobs:
    text = jax.jit(job).lower(*arguments).compile().as_text()
    moves = re.compile(r" (all-gather|all-to-all|collective-permute)(-start)?\(")
    lines = [line for line in text.splitlines() if moves.search(line)]
    assert not [line for line in lines if "u8[" in line]
    assert "all-reduce" in text
"""
    environ = os.environ | FOUR_DEVICES
    command = [sys.executable, "-c", code, name, json.dumps(settings)]
    subprocess.run(command, check=True, cwd=ROOT, env=environ)


def test_two_processes_learn_what_one_learns(tmp_path):
    options = f"--total-steps {3 * PER_ITERATION} --num-evals 1 --eval-episodes 2"
    finish("ppo", tmp_path / "one", options)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    spread = f"{options} --coordinator 127.0.0.1:{port} --num-processes 2 --process-id"
    processes = [
        subprocess.Popen(command("ppo", tmp_path / "two", f"{spread} {i}"), cwd=ROOT)
        for i in range(2)
    ]
    assert [process.wait(300) for process in processes] == [0, 0]
    assert_networks_are_close(tmp_path / "two", tmp_path / "one", 3 * PER_ITERATION)
