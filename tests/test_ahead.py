"""Programs of XLA are read as they are written; a small one is counted by hand."""

from __future__ import annotations

import subprocess
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

from tests.benchmarks.ahead import case, compiling, tables
from tests.benchmarks.ahead.case import DUMP, PROGRAMS
from tests.benchmarks.ahead.compiling import make_program
from tests.benchmarks.ahead.hlo import kernels, longest_chain, loops, parse
from tests.benchmarks.case import AbsentError

PROGRAM = """HloModule jit_ahead, is_scheduled=true

%fused_slice (p.0: f32[64,8], p.1: s32[]) -> f32[1,8] {
  %p.0 = f32[64,8]{1,0} parameter(0)
  %p.1 = s32[] parameter(1)
  %zero = s32[] constant(0)
  ROOT %row = f32[1,8]{1,0} dynamic-slice(%p.0, %p.1, %zero), dynamic_slice_sizes={1,8}
}

%body (carry: (s32[], f32[64,8])) -> (s32[], f32[64,8]) {
  %carry = (s32[], f32[64,8]{1,0}) parameter(0)
  %i = s32[] get-tuple-element(%carry), index=0
  %x = f32[64,8]{1,0} get-tuple-element(%carry), index=1
  %one = f32[1,8]{1,0} fusion(%x, %i), kind=kLoop, calls=%fused_slice
  %copied = f32[64,8]{1,0} copy(%x)
  ROOT %next = (s32[], /*index=1*/f32[64,8]{1,0}) tuple(%i, %copied)
}

%condition (carry.1: (s32[], f32[64,8])) -> pred[] {
  %carry.1 = (s32[], f32[64,8]{1,0}) parameter(0)
  %j = s32[] get-tuple-element(%carry.1), index=0
  ROOT %less = pred[] compare(%j, %j), direction=LT
}

ENTRY %main (a: f32[64,8]) -> f32[64,8] {
  %a = f32[64,8]{1,0} parameter(0)
  %first = f32[64,8]{1,0} copy(%a)
  %side = f32[64,8]{1,0} copy(%a)
  %start = s32[] constant(0)
  %both = (s32[], f32[64,8]{1,0}) tuple(%start, %first)
  %loop = (s32[], f32[64,8]{1,0}) while(%both), condition=%condition, body=%body COUNTED
  ROOT %out = f32[64,8]{1,0} get-tuple-element(%loop), index=1
}
"""
COUNTED = ', backend_config={"known_trip_count":{"n":"5"}}'


def test_a_counted_loop_multiplies_its_kernels():
    program = parse(PROGRAM.replace(" COUNTED", COUNTED))
    found = {kernel.name: kernel for kernel in kernels(program)}
    assert {name: kernel.launches for name, kernel in found.items()} == {
        "first": 1,
        "side": 1,
        "one": 5,
        "copied": 5,
    }
    assert loops(program) == [5]
    # A copy, then five turns in which the two kernels may run side by side.
    assert longest_chain(program) == 6


def test_a_slice_reads_what_it_takes():
    found = {kernel.name: kernel for kernel in kernels(parse(PROGRAM))}
    assert (found["one"].read, found["one"].written) == (32 + 4, 32)
    assert (found["copied"].read, found["copied"].written) == (2048, 2048)


def test_a_loop_of_unknown_length_counts_once_with_its_condition():
    program = parse(PROGRAM.replace(" COUNTED", ""))
    assert loops(program) == [None]
    assert sum(kernel.launches for kernel in kernels(program)) == 5
    # A copy, two kernels side by side, and the condition.
    assert longest_chain(program) == 3


def test_a_program_of_this_machine_is_read():
    compiled = jax.jit(lambda x: jax.lax.fori_loop(0, 3, lambda _, x: x @ x, x)).lower(
        jnp.ones((8, 8))
    )
    program = parse(compiled.compile().as_text())
    assert sum(kernel.launches for kernel in kernels(program)) >= 3


def test_another_text_is_refused():
    with pytest.raises(ValueError, match="no program of XLA"):
        parse("a poem")


@pytest.mark.slow
def test_the_programs_can_be_traced():
    for name in PROGRAMS:
        function, arguments = make_program(name, "inverted_pendulum", 2, backend="spring")
        assert jax.tree.leaves(jax.eval_shape(function, *arguments))


def test_an_unknown_program_is_refused():
    with pytest.raises(ValueError, match="Did you mean 'state step'"):
        make_program("state-step", "inverted_pendulum", 2)


def test_a_dump_that_the_user_asked_for_is_kept(monkeypatch, tmp_path):
    theirs, ours = tmp_path / "theirs", tmp_path / "ours"
    theirs.mkdir(), ours.mkdir()
    monkeypatch.setenv("XLA_FLAGS", f"--xla_dump_to={theirs} --xla_dump_to={ours}")
    monkeypatch.setenv(DUMP, str(ours))
    with pytest.raises(KeyError):
        compiling.gpu("ant", "renderer", 1, card="a card of another name")
    assert theirs.exists()
    assert not ours.exists()


def test_registers_are_those_of_the_largest_kernels(monkeypatch, tmp_path):
    sources = [tmp_path / "a.ptx", tmp_path / "b.ptx"]
    for source in sources:
        source.touch()
    told = iter(
        (
            "0 bytes stack frame, 8 bytes spill stores, 4 bytes spill loads\nUsed 40 registers",
            "0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads\nUsed 90 registers",
        )
    )
    monkeypatch.setattr(compiling, "find_assembler", lambda: "ptxas")
    monkeypatch.setattr(
        subprocess, "run", lambda *_, **__: SimpleNamespace(stderr=next(told), returncode=0)
    )
    assert compiling.assemble(sources, "sm_90a") == {"registers": 90, "spilled": 12}
    monkeypatch.setattr(compiling, "find_assembler", lambda: None)
    assert compiling.assemble(sources, "sm_90a") == {"registers": None, "spilled": None}


def test_the_compiler_is_that_of_the_running_jax_or_absent(monkeypatch, tmp_path):
    assert all(name.endswith(f"=={jax.__version__}") for name in case.packages("cuda")[:2])
    monkeypatch.setenv("PIXELBRAX_CACHE", str(tmp_path))
    monkeypatch.setattr(case, "packages", lambda _: ("no package of this name",))
    with pytest.raises(AbsentError, match="cannot be installed"):
        case.install("cuda")


def test_what_is_not_known_is_told_so():
    names = ("kernels", "launches", "longest_chain", "host_steps", "unknown_loops")
    names += ("temporary_bytes", "output_bytes", "read_bytes", "written_bytes")
    values = dict.fromkeys(names, 1)
    values |= {"registers": None, "spilled": None, "model_seconds": {"graph": 2e-5}}
    about = {"task": "ant", "num_envs": 1024, "program": "renderer"}
    row = {"status": "ok", "arguments": about, "values": values}
    assert "| not known |" in tables.gpu([row])
