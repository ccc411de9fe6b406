"""What JAX compiles while a block runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import jax


@contextmanager
def counted() -> Iterator[list[str]]:
    """The events of JAX's compiler: each trace, lowering and compilation."""
    events: list[str] = []

    def listen(event: str, duration: float, **details) -> None:
        if event.startswith("/jax/core/compile/"):
            events.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield events
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
