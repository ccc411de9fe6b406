"""Calls of Python functions by programs compiled for a CPU.

``jax.pure_callback`` starts other JAX operations in every call, which may wait for the calling
thread, and JAX does not cache programs with it. A call here reads and writes the program's memory
and takes some 20 microseconds; its program contains only a name, so JAX can cache it. This module
implements the C interface of XLA's foreign functions (``xla/ffi/api/c_api.h`` in jaxlib) by ctypes.
"""

from __future__ import annotations

import atexit
import ctypes
import math
import os
import re
import traceback
from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_TARGET = "pixelbrax_host_call"

_functions: dict[str, Callable[..., None]] = {}
"""Functions by the names that programs contain; kept as long as a program may run."""


def register(name: str, function: Callable[..., None]) -> None:
    """Let programs call ``function`` by ``name``, which must mean the same in every process.

    It is called with the operands as read-only arrays, then with the results as arrays to fill, in
    any thread. It must not use JAX, and may be called by several threads at once.
    """
    _functions[name] = function


def host_call(
    name: str, operands: Sequence[jax.Array], results: Sequence[jax.ShapeDtypeStruct]
) -> list[jax.Array]:
    """Return the results of the function registered as ``name`` for float32 or bool arrays.

    Only a CPU's programs may contain it. Under ``jax.vmap`` the function gets all rows at once,
    arrays with more axes in front. An exception of the function ends the program with an
    error of JAX that contains the traceback.
    """
    _register_target()
    call = jax.ffi.ffi_call(_TARGET, list(results), vmap_method="broadcast_all")
    return list(call(*operands, function=name))


class _Sized(ctypes.Structure):
    """A structure with XLA's header: its size, and extensions."""

    _fields_ = [("size", ctypes.c_size_t), ("extension", ctypes.c_void_p)]


class _Version(_Sized):
    _fields_ = [
        ("major", ctypes.c_int),
        ("minor", ctypes.c_int),
    ]


class _Metadata(ctypes.Structure):
    _fields_ = [
        ("size", ctypes.c_size_t),
        ("version", _Version),
        ("traits", ctypes.c_uint32),
        ("state_type", ctypes.c_int64),
    ]


class _Extension(ctypes.Structure):
    """The only kind that XLA has."""

    _fields_ = [
        ("size", ctypes.c_size_t),
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("metadata", ctypes.POINTER(_Metadata)),
    ]


class _Buffer(_Sized):
    _fields_ = [
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    ]


class _Buffers(_Sized):
    _fields_ = [
        ("count", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("items", ctypes.POINTER(ctypes.POINTER(_Buffer))),
    ]


class _Text(ctypes.Structure):
    _fields_ = [("data", ctypes.c_void_p), ("length", ctypes.c_size_t)]


class _Attributes(_Sized):
    _fields_ = [
        ("count", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("names", ctypes.c_void_p),
        ("items", ctypes.POINTER(ctypes.POINTER(_Text))),
    ]


class _ErrorArguments(_Sized):
    _fields_ = [
        ("message", ctypes.c_char_p),
        ("code", ctypes.c_int),
    ]


_CREATE_ERROR = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_ErrorArguments))
_INTERNAL = 13
"""XLA's code of an internal error."""


class _Api(_Sized):
    _fields_ = [
        ("version", _Version),
        ("internal", ctypes.c_void_p),
        ("create_error", _CREATE_ERROR),
    ]


class _Call(ctypes.Structure):
    _fields_ = [
        ("size", ctypes.c_size_t),
        ("extension", ctypes.POINTER(_Extension)),
        ("api", ctypes.POINTER(_Api)),
        ("context", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("operands", _Buffers),
        ("results", _Buffers),
        ("attributes", _Attributes),
    ]


_HANDLER = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_Call))
_NUM_WAITING = 256
"""Answers that wait; a call takes one and adds one before it computes anything."""
_create_error: Any = None
"""XLA's function, from the last call."""
_DTYPES = {1: np.dtype(bool), 11: np.dtype(np.float32)}
"""dtypes by XLA's numbers."""


@cache
def _version() -> tuple[int, int]:
    """Return the version of the interface, from jaxlib's own header."""
    header = Path(jax.ffi.include_dir(), "xla", "ffi", "api", "c_api.h").read_text("utf-8")
    numbers = re.findall(r"#define XLA_FFI_API_(?:MAJOR|MINOR) (\d+)", header)
    major, minor = map(int, numbers)
    return major, minor


def _arrays(buffers: _Buffers, *, writable: bool) -> list[np.ndarray]:
    arrays = []
    for i in range(buffers.count):
        buffer = buffers.items[i].contents
        shape, dtype = buffer.dims[: buffer.rank], _DTYPES[buffer.dtype]
        size = math.prod(shape) * dtype.itemsize
        # The address of an empty array may be null.
        memory = (ctypes.c_char * size).from_address(buffer.data) if size else bytearray()
        array = np.frombuffer(memory, dtype).reshape(shape)
        array.flags.writeable = writable
        arrays.append(array)
    return arrays


def _answer() -> Generator[Any, Any, None]:
    """Take a pointer to a ``_Call``, and yield a pointer to an error, or None."""
    global _create_error
    call = error = None
    try:
        call = (yield).contents
        _waiting.add()
        if call.extension:  # XLA asks for the version, when the function is registered
            metadata = call.extension.contents.metadata.contents
            metadata.version.major, metadata.version.minor = _version()
            metadata.traits = metadata.state_type = 0
        else:
            _create_error = call.api.contents.create_error
            text = call.attributes.items[0].contents
            function = _functions[ctypes.string_at(text.data, text.length).decode()]
            function(
                *_arrays(call.operands, writable=False),
                *_arrays(call.results, writable=True),
            )
    except GeneratorExit:
        return
    except BaseException:  # nothing may pass through the C code above
        if call is None:
            _waiting.add()
        message = traceback.format_exc().encode()
        size = ctypes.sizeof(_ErrorArguments)
        arguments = _ErrorArguments(size, None, message, _INTERNAL)
        error = _create_error(ctypes.byref(arguments))
    yield error


class _Waiting(deque[Callable[[Any], Any]]):
    """Calls the next of the answers that wait for a pointer, without Python code of its own.

    A signal that arrives in the C code above raises its exception in the first Python code after
    it. Before the ``try`` of a function ctypes would drop the exception and report success; a
    generator that waits in its ``try`` goes on there.
    """

    __call__ = property(deque.popleft)

    def add(self) -> None:
        """Let one more answer wait."""
        answer = _answer()
        next(answer)
        self.append(answer.send)


_waiting = _Waiting()
_handle = _HANDLER(_waiting)


@cache
def _register_target() -> None:
    for _ in range(_NUM_WAITING):
        _waiting.add()
    address = ctypes.cast(_handle, ctypes.c_void_p).value
    jax.ffi.register_ffi_target(_TARGET, jax.ffi.pycapsule(address), platform="cpu")
    atexit.register(_wait, os.getpid())


def _wait(process: int) -> None:
    """Wait for running programs when Python exits, because exiting during a call would crash.

    A CPU runs the programs of a thread in order, so waiting for a last program is enough for this
    thread. For other threads, wait for all live results.
    """
    if os.getpid() != process:  # XLA does not work in a forked process
        return
    try:
        devices = jax.local_devices(backend="cpu")
    except RuntimeError:  # JAX_PLATFORMS leaves CPUs out
        return
    for array in jax.live_arrays("cpu"):
        with suppress(Exception):  # a program that failed
            array.block_until_ready()
    for device in devices:
        jax.block_until_ready(jax.jit(jnp.negative)(jax.device_put(np.float32(0), device)))
