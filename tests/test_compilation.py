"""The options that programs are compiled with."""

import subprocess
import sys

import pytest

SCRIPT = """
import jax
import pixelbrax_jax as pb
options = pb.compiler_options()
program = jax.jit(lambda x: (x * 2.0).sum(), compiler_options=options)
print(options.get("xla_cpu_prefer_vector_width"), float(program(jax.numpy.ones(64))))
"""


@pytest.mark.parametrize(
    ("flags", "width"),
    [("", "512"), ("--xla_cpu_prefer_vector_width=128", "None")],
    ids=["ours", "the user's"],
)
def test_vectors_are_wide_unless_the_user_says_otherwise(monkeypatch, flags, width):
    monkeypatch.setenv("XLA_FLAGS", flags)
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True, timeout=120
    )
    assert done.stdout.split() == [width, "128.0"]


def test_an_xla_without_the_option_is_left_alone(monkeypatch):
    import pixelbrax_jax.compilation as compilation

    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(compilation, "_WIDTH", "xla_cpu_no_such_option")
    assert compilation.compiler_options() == {}
