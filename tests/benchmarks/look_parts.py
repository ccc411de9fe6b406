"""Measures what each part of the look `dmc` changes and costs, for docs/benchmarks/dmc.md.

    MUJOCO_GL=egl python -m tests.benchmarks.look_parts           all of it; 20 minutes
    MUJOCO_GL=egl python -m tests.benchmarks.look_parts speed     one measure; the cores must idle

One part at a time is left out of the whole picture: `pictures` compares with dm_control without
multisampling, `speed` times the renderer alone, all forms of a task in turns, and `policy` plays
the package's cartpole from the same starts. Results are kept in docs/dmc/parts.json.
"""

from __future__ import annotations

import argparse
import json
import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_gym.bench.machine import describe
from pixelbrax_jax import EnvParams, Look, PixelEnv, VectorPixelEnv, load_policy, make
from tests.benchmarks import suite_pictures
from tests.benchmarks.dmc_page import FOLDER, PARTS

KEPT = FOLDER / "parts.json"
DOMAINS = ("cartpole", "cheetah", "walker", "quadruped", "humanoid")
TASKS = ("dmc_cartpole_swingup", "dmc_cheetah_run", "dmc_walker_walk", "dmc_quadruped_walk", "ant")
NUM_ENVS, ROUNDS, EPISODES = 128, 15, 32
WHOLE, NONE, FOUR = "whole", "none", "four rays"


def forms(whole: Look, plain: Look) -> dict[str, Look]:
    """Return looks by their names in ``PARTS``: the whole one, without one part, without all."""
    kept = ("sky_texture", "ground_mark", "reflectance")
    return {
        WHOLE: whole,
        "sky": whole.replace(sky_texture=None),
        "marks": whole.replace(ground_mark=None),
        "light": plain.replace(**{name: getattr(whole, name) for name in kept}),
        "reflection": whole.replace(reflectance=None),
        "shadows": whole.replace(shadows=False),
        NONE: plain,
    }


def pictures() -> dict[str, Any]:
    """Mean absolute differences from dm_control, of 255, by domain, part and area."""
    found: dict[str, Any] = {}
    for domain in DOMAINS:
        case = suite_pictures.CASES[domain]
        single = suite_pictures.theirs(*case[:3], suite_pictures.SIZE, multisamples=0)
        for name in (name for name in PARTS if name != FOUR):
            drawn = suite_pictures.ours(*case, look_of=partial(_form, name))
            sides = {
                "ours": [suite_pictures.levels(frame) for frame in drawn],
                "single": single,
                "area": [suite_pictures.area(frame) for frame in drawn],
            }
            areas = suite_pictures.differences(sides, "ours, single")
            found.setdefault(domain, {})[name] = areas
            print(domain, name, areas, flush=True)
    return found


def _form(name: str, whole: Look, plain: Look) -> Look:
    return forms(whole, plain)[name]


def speed() -> dict[str, Any]:
    """Milliseconds to draw ``NUM_ENVS`` images of 84 x 84, medians, by task and part."""
    found = {}
    for task in TASKS:
        options = {"shadows": True} if task == "ant" else {}
        env, params = make(task, look="dmc", **options)
        plain = make(task, look="dmc-plain", **options)[1].look
        state, _ = VectorPixelEnv(PixelEnv(env.physics, obs_mode="state"), NUM_ENVS).reset(
            jax.random.key(0), params
        )
        looks = {
            name: look
            for name, look in forms(params.look, plain).items()
            if name in (WHOLE, NONE) or not _same(look, params.look)
        }
        drawn = {name: _compiled(env, params.replace(look=look)) for name, look in looks.items()}
        four = PixelEnv(env.physics, samples=4)
        drawn[FOUR] = _compiled(four, params)
        found[task] = _medians(drawn, state.sim)
        print(task, found[task], flush=True)
    return found


def _same(one: Look, other: Look) -> bool:
    leaves, others = jax.tree.flatten(one), jax.tree.flatten(other)
    return leaves[1] == others[1] and all(map(np.array_equal, leaves[0], others[0]))


def _compiled(env: PixelEnv, params: EnvParams) -> Any:
    draw = jax.jit(jax.vmap(env.draw, in_axes=(0, None)))
    return lambda sims: draw(sims, params)


def _medians(drawn: dict[str, Any], sims: Any) -> dict[str, float]:
    times: dict[str, list[float]] = {name: [] for name in drawn}
    for _ in range(ROUNDS):
        for name, run in drawn.items():
            # The first call after another form pays for its memory.
            jax.block_until_ready(run(sims))
            began = time.perf_counter()
            jax.block_until_ready(run(sims))
            times[name].append(time.perf_counter() - began)
    return {name: round(1e3 * float(np.median(taken)), 2) for name, taken in times.items()}


def policy() -> dict[str, Any]:
    """Returns of the package's cartpole swingup by part, from the same starts."""
    agent = load_policy("dmc_cartpole_swingup")
    env, params = make(**agent.env_options)
    plain = make(**agent.env_options | {"look": "dmc-plain"})[1].look
    envs, found = VectorPixelEnv(env, EPISODES), {}
    steps = int(params.episode_length) // env.action_repeat

    @jax.jit
    def returns(params: EnvParams) -> jax.Array:
        def step(carry: Any, _: None) -> tuple[Any, None]:
            state, obs, _ = carry
            state, timestep = envs.step(state, agent(obs), params)
            return (state, timestep.obs, timestep.info["episode_return"]), None

        state, timestep = envs.reset(jax.random.key(0), params)
        carry = state, timestep.obs, jnp.zeros(EPISODES)
        return jax.lax.scan(step, carry, None, steps)[0][2]

    for name, look in forms(params.look, plain).items():
        found[name] = np.asarray(returns(params.replace(look=look))).tolist()
        print(name, np.mean(found[name]), flush=True)
    return found


MEASURES = {"pictures": pictures, "speed": speed, "policy": policy}


def main() -> None:
    """Measure, and keep each measure at once."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("measures", nargs="*", default=list(MEASURES), metavar="measure")
    for name in parser.parse_args().measures:
        found = MEASURES[name]()
        kept = json.loads(KEPT.read_text("utf-8")) if KEPT.exists() else {}
        kept |= {name: found} | ({"machine": describe()} if name == "speed" else {})
        kept["num_envs"] = NUM_ENVS
        KEPT.write_text(json.dumps(kept, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
