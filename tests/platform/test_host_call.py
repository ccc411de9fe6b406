"""Programs call functions of Python, and are kept in JAX's cache all the same."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pixelbrax_jax._platform.host_call import host_call, register


def shape(*size, dtype=jnp.float32):
    return jax.ShapeDtypeStruct(size, dtype)


def test_a_function_reads_its_operands_and_fills_its_results():
    def split(x, nothing, low, is_low, empty):
        assert nothing.shape == (3, 0)
        assert empty.shape == (0, 2)
        assert not x.flags.writeable
        low[:] = np.minimum(x, 0)
        is_low[:] = x[:, 0] < 0

    register("test/split", split)

    @jax.jit
    def program(x):
        results = [shape(3, 2), shape(3, dtype=bool), shape(0, 2)]
        return host_call("test/split", [x, jnp.zeros((3, 0))], results)

    x = jnp.array([[-1.0, 2.0], [3.0, -4.0], [5.0, 6.0]])
    low, is_low, empty = program(x)
    np.testing.assert_array_equal(low, np.minimum(x, 0))
    np.testing.assert_array_equal(is_low, [True, False, False])
    assert empty.shape == (0, 2)


def test_an_error_ends_the_program_with_its_traceback():
    def fail(x, y):
        raise KeyError("a thing that is missing")

    register("test/fail", fail)
    program = jax.jit(lambda x: host_call("test/fail", [x], [shape(2)]))
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"in fail(.|\n)*a thing that is missing"):
        jax.block_until_ready(program(jnp.zeros(2)))
    register("test/fail", lambda x, y: np.copyto(y, x))
    np.testing.assert_array_equal(program(jnp.ones(2))[0], np.ones(2))


# JAX calls Python from within, e.g. in callbacks of weak references: what is raised there is lost.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="the system has no timers' signals")
def test_no_signal_is_lost_in_a_call():
    """Signals arrive in XLA, whose next Python code is the call's, and in the function."""

    class SignalError(Exception):
        pass

    def stop(number, frame):
        arrived.append(number)
        raise SignalError

    register("test/double", lambda x, y: np.add(x, x, out=y))
    program = jax.jit(lambda x: host_call("test/double", [x], [shape(2)])[0])
    x = jnp.ones(2)
    program(x).block_until_ready()
    delays, arrived, raised = random.Random(0), [], []
    before = signal.signal(signal.SIGALRM, stop)
    try:
        while len(arrived) < 300:
            try:
                signal.setitimer(signal.ITIMER_REAL, delays.uniform(1e-4, 2e-3))
                seen = len(arrived)
                while len(arrived) == seen:
                    np.testing.assert_array_equal(program(x).block_until_ready(), 2.0)
            except (SignalError, ValueError, jax.errors.JaxRuntimeError) as error:
                raised.append(f"{type(error)} {error}")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert all("SignalError" in text for text in raised)
    assert len(raised) > 0.98 * len(arrived)


@pytest.mark.timeout(60)
def test_calls_in_loops_of_many_threads_all_return():
    register("test/next", lambda x, y: np.add(x, 1, out=y))

    @jax.jit
    def count(x):
        def turn(_, x):
            return host_call("test/next", [x], [shape(4)])[0]

        return jax.lax.fori_loop(0, 2000, turn, x)

    results = {}

    def run(i):
        results[i] = np.asarray(count(jnp.full(4, float(i))))

    threads = [threading.Thread(target=run, args=(i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for i, found in results.items():
        np.testing.assert_array_equal(found, np.full(4, 2000.0 + i))
    assert len(results) == 8


PROGRAM = """
import json, logging
import jax, jax.numpy as jnp, numpy as np
from pixelbrax_jax._platform.host_call import host_call, register

register("test/double", lambda x, y: np.multiply(x, 2, out=y))
found = []
def listen(event, **options):
    found.append(event)
jax.monitoring.register_event_listener(listen)
y = jax.jit(lambda x: host_call("test/double", [x], [jax.ShapeDtypeStruct((3,), x.dtype)]))
y = y(jnp.arange(3.0))[0]
print(json.dumps({"y": y.tolist(), "hits": found.count("/jax/compilation_cache/cache_hits"),
                  "misses": found.count("/jax/compilation_cache/cache_misses")}))
"""


def test_another_process_finds_the_program_in_the_cache(tmp_path):
    def run():
        settings = {
            "JAX_COMPILATION_CACHE_DIR": str(tmp_path),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
        command = [sys.executable, "-W", "ignore", "-c", PROGRAM]
        done = subprocess.run(command, env=os.environ | settings, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    first, second = run(), run()
    assert first["y"] == second["y"] == [0, 2, 4]
    assert first["misses"] == second["hits"] > 0
    assert second["misses"] == 0


ENDING = """
import threading, time
import jax, jax.numpy as jnp, numpy as np
from pixelbrax_jax._platform.host_call import host_call, register

def slow(x, y):
    time.sleep(0.02)
    y[:] = x + 1
    print("call", flush=True)

register("test/slow", slow)
like = [jax.ShapeDtypeStruct((300, 300), np.float32)]

@jax.jit
def ten(x):  # large enough for JAX not to wait for it
    return jax.lax.fori_loop(0, 10, lambda _, x: host_call("test/slow", [x @ x], like)[0], x)

x = jnp.zeros((300, 300))
ten.lower(x).compile()
kept = []
"""


@pytest.mark.parametrize(
    "dispatch",
    ["ten(x)", "t = threading.Thread(target=lambda: kept.append(ten(x))); t.start(); t.join()"],
    ids=["nobody has the result", "in another thread"],
)
def test_python_ends_after_the_calls_of_a_program(dispatch):
    command = [sys.executable, "-W", "ignore", "-c", ENDING + dispatch]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == 10 * ["call"]
