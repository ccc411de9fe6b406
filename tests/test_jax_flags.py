"""Whatever flags of JAX a process has set, environments and agents give what they give without."""

import json
import subprocess
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pixelbrax_jax as pb
from pixelbrax_jax.agents.registry import ALGORITHMS
from pixelbrax_jax.distractors.presets import PRESETS
from pixelbrax_jax.envs.vector import AUTORESET_MODES
from pixelbrax_jax.flags import PRNG, under_default_flags
from pixelbrax_jax.tasks import TASKS
from tests.under_flags import KEY, SIZE, TASK, make, play

CHECKS = {
    "jax_debug_infs": True,
    "jax_debug_nans": True,
    "jax_transfer_guard": "disallow",
}
RULES = {
    "jax_default_matmul_precision": "bfloat16",
    "jax_default_prng_impl": "rbg",
    "jax_numpy_dtype_promotion": "strict",
    "jax_numpy_rank_promotion": "raise",
    "jax_threefry_partitionable": False,
}
X64 = {"jax_enable_x64": True}
ALONE = [
    *({name: value} for name, value in (CHECKS | RULES | X64).items()),
    *(
        {name: not getattr(jax.config, name)}
        for name in (
            "jax_check_tracer_leaks",
            "jax_debug_key_reuse",
            "jax_enable_checks",
            "jax_use_direct_linearize",
        )
        if hasattr(jax.config, name)
    ),
    {"jax_cpu_enable_async_dispatch": False},
    {"jax_default_matmul_precision": "highest"},
    {"jax_default_prng_impl": "unsafe_rbg"},
    {"jax_explicit_x64_dtypes": "error"},
    {"jax_legacy_prng_key": "error"},
]
"""Flags that change what programs JAX makes or accepts, or what it checks."""

PARTS = (
    *(f"env:{TASK}", "env:dmc_cartpole_swingup,color"),
    *("gymnasium", "sb3", "torchrl", "train:ppo"),
)


def under(flags: dict[str, object], *parts: str) -> dict[str, str]:
    """Digests of parts, in a process of its own with flags."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-m", "tests.under_flags", json.dumps(flags), *parts],
        capture_output=True,
        text=True,
        timeout=840,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def without(*parts: str) -> dict[str, str]:
    """What ``under`` gives without flags."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return {name: digest for part in parts for name, digest in play(part).items()}


@pytest.mark.parametrize(
    ("flags", "part"),
    [
        (X64 | RULES, "program:dmc_pendulum_swingup,color"),
        pytest.param(X64 | RULES, f"env:{TASK}", marks=pytest.mark.slow),
        pytest.param(CHECKS, "gymnasium", marks=pytest.mark.slow),
    ],
    ids=["program", "rules", "checks"],
)
def test_environments_are_the_same(flags, part):
    assert under(flags, part) == without(part)


@pytest.mark.parametrize("mode", AUTORESET_MODES)
def test_no_value_of_a_program_outlives_it(mode):
    """As ``jax.checking_leaks`` finds: JAX keeps forms of functions, and what they close over."""
    env, params = make(f"{TASK},dcs-easy")
    envs = pb.VectorPixelEnv(env, 3, mode)
    state, timestep = jax.eval_shape(envs.reset, KEY, params)
    action = jax.ShapeDtypeStruct((3, env.action_size), np.float32)

    def program(state, action, mask, params):
        return envs.step(state, action, params), envs.reset_where(state, mask, params)

    with jax.checking_leaks():
        jax.jit(program).trace(state, action, timestep.terminated, params)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("flags", ALONE, ids=json.dumps)
def test_everything_is_the_same_under_each_flag(flags):
    assert under(flags, *PARTS) == without(*PARTS)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("algorithm", [name for name in ALGORITHMS if name != "ppo"])
def test_other_agents_learn_the_same(algorithm):
    assert under(X64 | RULES, f"train:{algorithm}") == without(f"train:{algorithm}")


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("first", range(0, len(TASKS), 6))
def test_every_task_is_the_same_program(first):
    parts = [f"program:{task}" for task in sorted(TASKS)[first : first + 6]]
    assert under(X64 | RULES, *parts) == without(*parts)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_every_distractor_and_renderer_is_the_same_program():
    parts = [f"program:{TASK},{distractor}" for distractor in PRESETS]
    parts += [f"program:{TASK}/{renderer}" for renderer in ("fused", "reference")]
    assert under(X64 | RULES, *parts) == without(*parts)
    # Its loops count, and index, with 64 bits. It is interpreted until the process ends.
    kernel = f"env:{TASK}/pallas"
    wanted = under({}, kernel)
    assert not any("Error" in found for found in wanted.values())
    assert under(X64 | RULES, kernel) == wanted


@pytest.mark.parametrize(
    ("platform", "name"), [("cuda", f"{TASK},camera"), ("tpu", "dmc_pendulum_swingup")]
)
def test_accelerators_round_no_factor_of_a_product(platform, name):
    env, params = make(name)
    envs = pb.VectorPixelEnv(env, 2)
    with jax.default_matmul_precision("bfloat16"):
        program = type(envs).reset.trace(envs, KEY, params).lower(lowering_platforms=(platform,))
    products = [line for line in program.as_text().splitlines() if "dot_general" in line]
    assert len(products) > 5
    assert all("[HIGHEST, HIGHEST]" in line for line in products)


def test_what_a_user_made_of_64_bits_is_rounded():
    given = []

    @jax.jit
    @under_default_flags
    def program(x, n, key):
        given.extend((x.dtype, n.dtype, jnp.linspace(0, 1, 3).dtype, jax.random.key_impl(key)))
        return x, n, jax.random.bits(key)

    with jax.enable_x64(True), jax.default_prng_impl("rbg"):
        x, n, bits = program(jnp.float64(0.1), jnp.int64(3), jax.random.key(7))
    assert given == [np.float32, np.int32, np.float32, PRNG]
    assert (x, n, x.dtype, n.dtype) == (np.float32(0.1), 3, np.float32, np.int32)
    assert bits == jax.random.bits(jax.random.key(7))


def test_derivatives_are_those_without_flags():
    env, params = pb.make(TASK, **SIZE, renderer="fused")
    state, _ = env.reset(jax.random.key(0), params)

    def brightness(sky):
        look = params.look.replace(sky=sky)
        frame = env.render(state, params.replace(look=look))
        return jnp.sum(frame.r) + jnp.sum(jnp.where(frame.seg >= 0, frame.depth, 0))

    expected = jax.grad(brightness)(params.look.sky)
    with jax.enable_x64(True), jax.debug_infs(True):
        gradient = jax.grad(brightness)(jnp.asarray(params.look.sky, jnp.float64))
        assert gradient.dtype == np.float64
    np.testing.assert_array_equal(gradient, expected)


@pytest.mark.slow
def test_brax_environments_of_64_bits_are_the_same_physics():
    from brax import envs

    from pixelbrax_jax.physics.mujoco.compatibility import known_warnings_silenced

    def play_brax():
        with known_warnings_silenced():
            physics = pb.BraxPhysics(envs.get_environment(TASK))
        first = physics.reset(jax.random.key(0))
        return first, physics.step(first, jnp.full(1, 0.5)), physics.dt

    expected = play_brax()
    with jax.enable_x64(True):
        found = play_brax()
    assert jax.tree.map(lambda x: getattr(x, "dtype", None), found) == jax.tree.map(
        lambda x: getattr(x, "dtype", None), expected
    )
    jax.tree.map(np.testing.assert_array_equal, found, expected)
