"""How fast this checkout steps environments with pixels, beside another one of the project.

    git worktree add --detach ../before <commit>
    python -m tests.benchmarks.revisions ../before --task halfcheetah ant --num-envs 4 256

Two processes, one of each checkout, run the same steps in short turns, so that both meet what
else changes the machine's speed. Both use the packages of this Python. Prints JSON, then a table.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

from pixelbrax_gym.bench.tables import table
from pixelbrax_jax.processor import describe_cpu

HERE = Path(__file__).parents[2]
WORKER = """
import hashlib, pathlib, sys, time
checkout, task, num_envs = pathlib.Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
import jax, jax.numpy as jnp, numpy as np
import pixelbrax_jax as pb
assert pathlib.Path(pb.__file__).is_relative_to(checkout), pb.__file__
env, params = pb.make(task, height=84, width=84, frame_stack=3)
envs, options = pb.VectorPixelEnv(env, num_envs, "same_step"), pb.compiler_options(env)

def steps(state, key, params):
    def one(state, key):
        actions = jax.random.uniform(key, (num_envs, env.action_size), minval=-1)
        state, timestep = envs.step(state, actions, params)
        pixels = timestep.obs.astype(jnp.uint32).sum()
        return state, (timestep.reward, pixels, timestep.terminated)
    return jax.lax.scan(one, state, jax.random.split(key, 30))

keys = jax.vmap(jax.random.key)(jnp.arange(num_envs))
start = jax.jit(envs.reset, compiler_options=options)(keys, params)[0], jax.random.key(1), params
run = jax.jit(steps, compiler_options=options).lower(*start).compile()

def timed(repeats):
    before = time.perf_counter()
    for _ in range(repeats):
        jax.block_until_ready(run(*start))
    return time.perf_counter() - before

_, results = run(*start)
digest = hashlib.sha256(b"".join(np.asarray(x).tobytes() for x in results)).hexdigest()
repeats = max(1, round(0.4 / min(timed(1), timed(1))))
print(digest, flush=True)
for _ in sys.stdin:
    print(30 * num_envs * repeats / timed(repeats), flush=True)
"""
"""Prints a digest of 30 steps' rewards, pixels and ends; then for each line steps per second."""


def compare(other: Path, task: str, num_envs: int, rounds: int) -> dict[str, Any]:
    """Steps per second of both checkouts, and the ratio of this one to the other, by round."""
    with contextlib.ExitStack() as started:
        workers, digests = [], []
        for checkout in (HERE, other):
            command = [sys.executable, "-P", "-c", WORKER, str(checkout), task, str(num_envs)]
            environ = os.environ | {"PYTHONPATH": str(checkout)}
            worker = started.enter_context(
                subprocess.Popen(
                    command, env=environ, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
                )
            )
            workers.append(worker)
            # The next one starts when this one has compiled.
            digests.append(_answer(worker))
        speeds: list[list[float]] = []
        for index in range(rounds):
            order = workers if index % 2 else workers[::-1]
            found = {worker.pid: float(_answer(worker, "go\n")) for worker in order}
            speeds.append([found[worker.pid] for worker in workers])
    ratios = sorted(here / there for here, there in speeds)
    return {
        "task": task,
        "num_envs": num_envs,
        "same_results": digests[0] == digests[1],
        "steps_per_second": [statistics.median(each) for each in zip(*speeds, strict=True)],
        "ratio": statistics.median(ratios),
        "ratio_quartiles": [ratios[len(ratios) // 4], ratios[-1 - len(ratios) // 4]],
        "rounds": rounds,
    }


def _answer(worker: subprocess.Popen[str], question: str = "") -> str:
    assert worker.stdin is not None, "a pipe was asked for"
    assert worker.stdout is not None, "a pipe was asked for"
    worker.stdin.write(question)
    worker.stdin.flush()
    if not (line := worker.stdout.readline()):
        raise RuntimeError(f"a process has ended with {worker.wait()}; its errors are above")
    return line.strip()


def main() -> None:
    """Compare all cases, one after the other."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("other", type=lambda path: Path(path).resolve(strict=True))
    tasks = ["halfcheetah", "ant", "dmc_cartpole_swingup", "dmc_cheetah_run"]
    parser.add_argument("--task", nargs="+", default=tasks)
    parser.add_argument("--num-envs", nargs="+", type=int, default=[4, 100, 256])
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args()
    lines = []
    for task in options.task:
        for num_envs in options.num_envs:
            found = compare(options.other, task, num_envs, options.rounds)
            print(json.dumps(found | {"machine": describe_cpu()}), flush=True)
            low, high = found["ratio_quartiles"]
            here, there = found["steps_per_second"]
            ratio = f"{found['ratio']:.3f} ({low:.3f} to {high:.3f})"
            same = "yes" if found["same_results"] else "no"
            lines.append([task, str(num_envs), f"{here:,.0f}", f"{there:,.0f}", ratio, same])
    heads = ["task", "environments", "steps/s", "of the other", "ratio (quartiles)", "same results"]
    print("\n" + table(heads, lines))


if __name__ == "__main__":
    main()
