"""What a caller does to results reaches no environment."""

from __future__ import annotations

import jax
import numpy as np
import pytest
import torch

from tests.compilations import counted
from tests.gym.adapters import as_bytes
from tests.gym.test_same_everywhere import ADAPTERS_AND_JAX


def spoil(returned):
    """Write to every array that a caller may write to."""
    for leaf in jax.tree.leaves(returned):
        if isinstance(leaf, torch.Tensor):
            leaf.fill_(1)
        elif isinstance(leaf, np.ndarray) and leaf.dtype == object:
            spoil(list(leaf))
        elif isinstance(leaf, np.ndarray):
            leaf[...] = 1


@pytest.mark.parametrize("name", sorted(set(ADAPTERS_AND_JAX) - {"jax"}))
def test_writing_to_results_changes_nothing_later(name):
    clean, dirty = ADAPTERS_AND_JAX[name](), ADAPTERS_AND_JAX[name]()
    returned = dirty.reset()
    assert as_bytes(returned) == as_bytes(clean.reset())
    for _ in range(30):
        spoil(returned)
        returned = dirty.call()[1]
        assert as_bytes(returned) == as_bytes(clean.call()[1])
    spoil(returned)
    assert as_bytes(dirty.reset(seed=7)) == as_bytes(clean.reset(seed=7))


@pytest.mark.parametrize("name", ADAPTERS_AND_JAX)
def test_nothing_is_compiled_twice(name):
    adapter = ADAPTERS_AND_JAX[name]()
    adapter.reset()
    for _ in range(30):
        adapter.call()
    with counted() as events:
        adapter.reset(seed=1)
        for _ in range(100):
            adapter.call()
    assert not events
