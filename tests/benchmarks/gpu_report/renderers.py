"""MuJoCo Warp's ray tracer on the same device, with a task's own model and our camera."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from pixelbrax_gym.bench.throughput import rate
from tests.benchmarks import scene
from tests.benchmarks.case import ABSENT, AbsentError
from tests.benchmarks.gpu_report.programs import run_program

Measure = Callable[[float], dict[str, Any]]


def mjx(task: str, num_envs: int, size: int) -> Measure:
    """Measure ``mujoco.mjx.render``, which calls MuJoCo Warp from a compiled JAX program."""
    import jax
    import mujoco
    from mujoco import mjx
    from mujoco.mjx import warp

    if not warp.WARP_INSTALLED:
        raise AbsentError('mjx.render needs warp-lang: pip install "mujoco-mjx[warp]"')
    view = scene.describe(task)
    model = mujoco.MjModel.from_xml_string(view["xml"])
    on_device = mjx.put_model(model, impl="warp")
    context = mjx.create_render_context(
        model, nworld=num_envs, cam_res=(size, size), render_rgb=True, render_depth=False,
        use_textures=False, use_shadows=False,
    )  # fmt: skip
    handle = context.pytree()
    pose = jax.numpy.asarray(view["qpos"])

    def world(_: jax.Array) -> Any:
        return mjx.make_data(model, impl="warp").replace(qpos=pose)

    def draw(data: Any) -> Any:
        data = mjx.refit_bvh(on_device, data, handle)
        return mjx.render(on_device, data, handle)[0]

    graphs = {"xla_gpu_graph_min_graph_size": 1}
    data = jax.jit(jax.vmap(world))(jax.numpy.arange(num_envs))
    forward = jax.jit(jax.vmap(mjx.forward, in_axes=(None, 0)), compiler_options=graphs)
    data = jax.block_until_ready(forward(on_device, data))
    program = jax.jit(jax.vmap(draw), compiler_options=graphs).lower(data).compile()

    def run(calls: int) -> Any:
        for _ in range(calls):
            image = program(data)
        return image

    def timed(_: float) -> dict[str, Any]:
        image = jax.device_get(run(1))
        if image.min() == image.max():
            raise RuntimeError("it draws nothing")
        speed = rate(run)
        return {"frames_per_second": num_envs * speed["median"], "speed": speed}

    return timed


def warp(task: str, num_envs: int, size: int) -> Measure:
    """Measure MuJoCo Warp's newest release, in an environment of its own, without JAX."""
    from tests.benchmarks.cases import PeerCase

    where = {"task": task, "num_envs": num_envs, "size": size}
    command = PeerCase("peers", "peers.mujoco_warp_renderer", where, peer="mujoco_warp").command()

    def timed(seconds: float) -> dict[str, Any]:
        told, status = run_program(command, seconds, {})
        if status == ABSENT:
            raise AbsentError(told.strip())
        if status != 0:
            raise RuntimeError(told[-2000:])
        found: dict[str, Any] = json.loads(told.strip().splitlines()[-1])["values"]
        return found

    return timed
