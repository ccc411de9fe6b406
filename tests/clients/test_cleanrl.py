"""A script in CleanRL's manner logs the returns that were paid, on the frames that were drawn."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.clients import cleanrl_ppo
from tests.clients.ball import ID, LIMIT, SIZE, assert_same_images, make

GRAY = np.array([0.2125, 0.7154, 0.0721])


@pytest.mark.parametrize("kind", ["sync", "fast"])
def test_a_script_in_cleanrls_manner(kind):
    stack = 1 if kind == "sync" else 2
    args = cleanrl_ppo.Args(env_id=ID, env_options=SIZE | {"frame_stack": stack})
    make_envs = cleanrl_ppo.make_sync if kind == "sync" else cleanrl_ppo.make_fast
    result = cleanrl_ppo.main(args, make_envs(args))

    after = list(result["agent"].parameters())
    assert all(p.isfinite().all() for p in after)
    assert all((p != q).any() for p, q in zip(after, result["before"], strict=True))

    returns = []
    for i in range(args.num_envs):
        steps = (result[name][:, i] for name in ("obs", "actions", "rewards", "dones"))
        returns.append(replay(args, i, *steps, gray=kind == "sync"))
    # An episode of 6 steps and one that resets: four whole ones in 32 steps, all at once.
    expected = np.array(returns).T.ravel()
    assert len(expected) == 3 * 4
    logged, lengths = zip(*result["episodes"], strict=True)
    assert_allclose(logged, expected, rtol=1e-5)
    assert set(lengths) == {LIMIT}


def replay(args, i, obs, actions, rewards, dones, gray):
    """Takes the same actions without any wrapper; the returns of whole episodes."""
    env = make(**args.env_options)
    frame, _ = env.reset(seed=args.seed + i)
    frames = [frame, frame]
    returns, total, ended = [], 0.0, False
    for t in range(len(actions)):
        assert dones[t] == ended
        assert_same_images(obs[t], as_stacked(frames) if gray else frame)
        if ended:
            frame, _ = env.reset()
            frames, reward, ended = [frame, frame], 0.0, False
        else:
            frame, reward, terminated, truncated, _ = env.step(np.clip(actions[t], -1, 1))
            frames, ended = [*frames, frame], terminated or truncated
        assert rewards[t] == pytest.approx(reward, rel=1e-6)
        total += reward
        if ended:
            returns.append(total)
            total = 0.0
    return returns


def as_stacked(frames):
    """Two gray frames on a new axis, as the script's wrappers make them."""
    return np.stack([np.uint8((frame * GRAY).sum(axis=-1)) for frame in frames[-2:]])
