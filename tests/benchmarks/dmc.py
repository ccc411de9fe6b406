"""Tasks of the DM Control Suite through Gymnasium: steps per second, seconds to the first frame."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from typing import Any

import numpy as np

from pixelbrax_jax.tasks import TASKS
from tests.benchmarks.startup import last_line, with_cache


def pixels(task: str, num_envs: int) -> dict[str, Any]:
    """Measure 84 x 84 pixels, three frames, as NumPy arrays, with random actions.

    Two processes follow each other, each with its own clock from its start to the end of its first
    step. The first one finds an empty compilation cache, the second one that of the first.
    """
    with tempfile.TemporaryDirectory() as folder:
        environ = with_cache(folder)
        first = _process(task, num_envs, "measure", environ)
        again = _process(task, num_envs, "start", environ)
    return {
        "steps_per_second": num_envs * first["speed"]["median"],
        "speed": first["speed"],
        "first_frame": {"without": first["first_frame"], "with": again["first_frame"]},
    }


def with_look(task: str, num_envs: int, look: str) -> dict[str, Any]:
    """Measure the same with a look; steps a second alone."""
    with tempfile.TemporaryDirectory() as folder:
        speed = _process(task, num_envs, "measure", with_cache(folder), look)["speed"]
    return {"steps_per_second": num_envs * speed["median"], "speed": speed}


def _process(
    task: str, num_envs: int, what: str, environ: dict[str, str], look: str = "default"
) -> dict[str, Any]:
    arguments = [TASKS[task].gymnasium_id, str(num_envs), what, str(time.time()), look]
    return last_line(["-m", __name__, *arguments], environ)


def main() -> None:
    """Start, step once, and measure if asked to."""
    name, num_envs, what, started = sys.argv[1], int(sys.argv[2]), sys.argv[3], float(sys.argv[4])
    look = sys.argv[5]
    import gymnasium

    import pixelbrax_gym  # noqa: F401  # registers the ids

    envs = gymnasium.make_vec(name, num_envs=num_envs, output="numpy", look=look)
    envs.reset(seed=0)
    low, high = envs.action_space.low, envs.action_space.high
    draw = np.random.default_rng(0)
    obs = envs.step(draw.uniform(low, high).astype(np.float32))[0]
    found: dict[str, Any] = {"first_frame": time.time() - started}
    if np.ptp(obs) == 0:
        raise RuntimeError("it draws nothing")

    def run(calls: int) -> Any:
        for _ in range(calls):
            obs = envs.step(draw.uniform(low, high).astype(np.float32))[0]
        return obs

    if what == "measure":
        from pixelbrax_gym.bench.throughput import rate

        found["speed"] = rate(run)
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
