"""Gymnasium's own wrappers on top; `tests/clients` has all of them."""

from __future__ import annotations

import numpy as np
from gymnasium import wrappers
from gymnasium.wrappers import vector as vector_wrappers

ACTIONS = np.full((3, 1), -0.1, np.float32)


def test_statistics_survive_a_partial_reset(make_vector):
    # The wrapper looks for the mask after the environment has seen it: it must still be there.
    env = vector_wrappers.RecordEpisodeStatistics(
        make_vector(obs_mode="state", autoreset_mode="disabled")
    )
    env.reset(seed=0)
    for _ in range(3):
        env.step(ACTIONS)
    env.reset(options={"reset_mask": np.array([True, False, False])})
    for _ in range(3):
        infos = env.step(ACTIONS)[4]
    np.testing.assert_array_equal(infos["_episode"], [False, True, True])
    np.testing.assert_array_equal(infos["episode"]["l"], [0, 6, 6])


def test_frame_stack_of_ours_is_that_of_gymnasium(make_single):
    theirs = wrappers.FrameStackObservation(make_single(frame_stack=1), 2)
    ours = make_single(frame_stack=2)
    pairs = [(ours.reset(seed=0)[0], theirs.reset(seed=0)[0])]
    pairs += [(ours.step(np.ones(1))[0], theirs.step(np.ones(1))[0]) for _ in range(4)]
    for mine, other in pairs[1:]:
        np.testing.assert_array_equal(mine, np.concatenate(list(other), axis=-1))
