"""TorchRL's own adapters to Gymnasium, and its collectors, on our environments."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import GymEnv, GymWrapper, ParallelEnv, SerialEnv, check_env_specs

from tests.clients.ball import ACTIONS, ID, LIMIT, SIZE, make, make_vec

make_ball = partial(GymEnv, ID, **SIZE)


def rollout(env, actions):
    """Steps a TorchRL environment by the given actions, whatever ends: a batch with time last."""
    td, steps = env.reset(), []
    for action in actions:
        stepped, td = env.step_and_maybe_reset(td.set("action", torch.as_tensor(action)))
        steps.append(stepped.clone())
    return torch.stack(steps, dim=-1)


def two_episodes(seed, actions, resets=1):
    """The same in Gymnasium. TorchRL's ``set_seed`` begins an episode that nobody sees."""
    env = make()
    env.reset(seed=seed)
    obs, _ = env.reset()
    rows = []
    for action in actions:
        after, reward, terminated, truncated, _ = env.step(action)
        rows.append((obs, after, reward, terminated, truncated))
        obs = after
        if terminated or truncated:
            obs = [env.reset()[0] for _ in range(resets)][-1]
    return [np.stack(column) for column in zip(*rows, strict=True)]


def agree(batch, expected, key="pixels"):
    """Asserts that a batch of TorchRL has what Gymnasium's environment handed out."""
    before, after, rewards, terminated, truncated = expected
    assert batch[key].dtype == torch.uint8
    assert_array_equal(batch[key], before)
    assert_array_equal(batch["next", key], after)
    assert_allclose(batch["next", "reward"][..., 0], rewards, rtol=1e-6)
    assert_array_equal(batch["next", "terminated"][..., 0], terminated)
    assert_array_equal(batch["next", "truncated"][..., 0], truncated)
    assert truncated[LIMIT - 1]


def test_gym_env_makes_a_task_by_its_id():
    env = GymEnv("PixelBrax/InvertedPendulum-v0", obs_mode="state", height=8, width=8)
    check_env_specs(env)
    rewards = rollout(env, np.zeros((3, 1), np.float32))["next", "reward"]
    assert_array_equal(rewards.ravel(), [1, 1, 1])
    env.close()


def test_gym_env_hands_out_what_gymnasium_does():
    env = make_ball()
    env.set_seed(3)
    agree(rollout(env, ACTIONS), two_episodes(3, ACTIONS))


def test_gym_env_repeats_actions():
    env = make_ball(frame_skip=2)
    env.set_seed(3)
    rewards = rollout(env, ACTIONS[[0, 2, 4]])["next", "reward"].ravel()
    _, _, paid, _, _ = two_episodes(3, ACTIONS[[0, 0, 2, 2, 4, 4]])
    assert_allclose(rewards, paid.reshape(3, 2).sum(axis=1), rtol=1e-6)


def test_gym_env_takes_pictures_of_render():
    options = SIZE | {"obs_mode": "state", "render_height": 16, "render_width": 16}
    env = GymEnv(ID, from_pixels=True, pixels_only=False, **options)
    env.set_seed(3)
    batch = rollout(env, ACTIONS[:3])
    bare = make(**options, render_mode="rgb_array")
    bare.reset(seed=3)
    state, _ = bare.reset()
    for t in range(3):
        assert_array_equal(batch["pixels"][t], bare.render())
        assert_array_equal(batch["observation"][t], state)
        state, *_ = bare.step(ACTIONS[t])


# torch warns, once in a process, of arrays that cannot be written to: the bounds of batched spaces,
# which are one number each. TorchRL only reads them.
@pytest.mark.filterwarnings("ignore:The given NumPy array is not writable:UserWarning")
# Where all episodes end at once, TorchRL resets what has reset itself in the same step.
@pytest.mark.parametrize(("mode", "resets"), [("same_step", 2), ("disabled", 1)])
def test_gym_wrapper_takes_a_vector_environment(mode, resets):
    env = GymWrapper(make_vec(2, autoreset_mode=mode))
    assert env.batch_size == (2,)
    env.set_seed(3)
    batch = rollout(env, np.stack([ACTIONS, ACTIONS], axis=1))
    for i in range(2):
        # It calls a batch of images an observation.
        agree(batch[i], two_episodes(3 + i, ACTIONS, resets), "observation")


def test_workers_that_are_spawned_hand_out_what_a_loop_does():
    serial, parallel = SerialEnv(2, make_ball), ParallelEnv(2, make_ball, mp_start_method="spawn")
    actions = np.stack([ACTIONS, -ACTIONS], axis=1)
    batches = []
    for env in (serial, parallel):
        env.set_seed(3)
        batches.append(rollout(env, actions))
        env.close()
    expected, batch = batches
    agree(batch[0], two_episodes(3, ACTIONS))
    for key in ("pixels", ("next", "pixels"), ("next", "reward"), ("next", "truncated")):
        assert_array_equal(batch[key], expected[key])


COLLECTORS = {
    "one": lambda: Collector(make_ball, None, frames_per_batch=16, total_frames=32),
    "two-sync": lambda: MultiSyncCollector(
        [make_ball] * 2, None, frames_per_batch=16, total_frames=32
    ),
    "two-async": lambda: MultiAsyncCollector(
        [make_ball] * 2, None, frames_per_batch=16, total_frames=32
    ),
}


@pytest.mark.parametrize("kind", COLLECTORS)
def test_collectors_gather_true_transitions(kind):
    collector = COLLECTORS[kind]()
    count = ends = 0
    try:
        for batch in collector:
            count += batch.numel()
            for steps in batch if batch.ndim == 2 else [batch]:
                ends += check_transitions(steps)
    finally:
        collector.shutdown()
    assert count == 32
    assert ends >= 2


def check_transitions(steps):
    """Asserts that each step begins where the one before ended; returns how many episodes did."""
    ids = steps["collector", "traj_ids"]
    done = steps["next", "done"][:, 0]
    goes_on = (ids[1:] == ids[:-1]) & ~done[:-1]
    assert goes_on.any()
    assert (steps["next", "pixels"][:-1] == steps["pixels"][1:])[goes_on].all()
    # Actions move the ball: its reward is where it is.
    moved = steps["next", "reward"][1:, 0] - steps["next", "reward"][:-1, 0]
    assert_allclose(moved[goes_on], 0.1 * steps["action"][1:, 0][goes_on], atol=1e-6)
    return int(done.sum())
