"""The TorchRL adapter: its contract, true transitions, partial resets, clear errors."""

from __future__ import annotations

import subprocess
import sys

import jax
import numpy as np
import pytest
import torch
from gymnasium import error
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import Unbounded
from torchrl.envs import (
    CatFrames,
    Compose,
    RewardSum,
    StepCounter,
    ToTensorImage,
    TransformedEnv,
    check_env_specs,
)
from torchrl.record import CSVLogger, PixelRenderTransform, VideoRecorder

import pixelbrax_gym
import pixelbrax_jax
from pixelbrax_gym.interop.dlpack import torch_device
from pixelbrax_gym.torchrl import specs as torchrl_specs
from pixelbrax_gym.torchrl.specs import PixelSpec
from pixelbrax_jax.tasks import BRAX_TASKS
from tests.gym.conftest import ID, TASK

RIGHT = np.array([[-0.2], [0.9], [1.0]], np.float32)
"""Ball 0 stays until the time limit; 1 and 2 leave the line, one before the other."""

STAY = np.zeros((3, 1), np.float32)


def act(td, action=RIGHT):
    return td.set("action", torch.as_tensor(action))


def policy(td):
    return act(td, np.resize(RIGHT, (*td.shape, 1)))


@pytest.mark.parametrize("obs_mode", ["pixels", "state", "both"])
def test_specs(make_torchrl, obs_mode):
    check_env_specs(make_torchrl(obs_mode=obs_mode))


@pytest.mark.slow
@pytest.mark.parametrize("task", BRAX_TASKS)
def test_specs_of_every_task(task):
    env = pixelbrax_gym.TorchRLEnv(task, 2, height=16, width=16, obs_mode="both")
    check_env_specs(env)
    env.close()


def test_keys_shapes_and_types(make_torchrl):
    env = make_torchrl(obs_mode="both")
    td = env.rand_step(env.reset())
    expected = {
        "pixels": ((3, 12, 12, 6), torch.uint8),
        "observation": ((3, 2), torch.float32),
        "reward": ((3, 1), torch.float32),
        "done": ((3, 1), torch.bool),
        "terminated": ((3, 1), torch.bool),
        "truncated": ((3, 1), torch.bool),
    }
    assert {key: (tuple(value.shape), value.dtype) for key, value in td["next"].items()} == expected
    assert td["action"].abs().max() <= 1.0
    assert env.batch_size == torch.Size([3])
    assert env.device == torch.device("cpu")


@pytest.mark.parametrize("break_when", [True, False, "both"])
def test_rollouts_count_every_step(make_torchrl, break_when):
    env = make_torchrl(obs_mode="both")
    options = {"break_when_any_done": break_when is True}
    if break_when == "both":
        options["break_when_all_done"] = True
    ended = 0
    for _ in range(3):
        data = env.rollout(40, policy, **options)
        check_transitions(data, frozen_after_end=break_when == "both")
        ended += data["next", "done"].sum()
    assert ended


def check_transitions(data, *, frozen_after_end=False):
    """The toy's second state feature counts steps: 0 first, and one more with each transition.

    Where one environment's end does not end the rollout, TorchRL repeats its last transition.
    """
    steps = data["observation"][..., 1]
    assert (data["next", "observation"][..., 1] == steps + 1).all()
    assert (steps[..., 0] == 0).all()
    # Where an episode went on, the next transition starts where this one ended.
    goes_on = ~data["next", "done"][..., :-1, 0]
    for key in ("pixels", "observation"):
        after, before = data["next", key][..., :-1, :], data[key][..., 1:, :]
        if key == "pixels":
            after, before = data["next", key][:, :-1], data[key][:, 1:]
        assert (after[goes_on] == before[goes_on]).all()
    if frozen_after_end:
        assert (steps[..., 1:][~goes_on] == steps[..., :-1][~goes_on]).all()
    else:
        assert (steps[..., 1:][~goes_on] == 0).all()


def test_collector_transitions_are_true(make_torchrl):
    collector = Collector(
        make_torchrl(obs_mode="both"), policy, frames_per_batch=90, total_frames=180
    )
    batches = [batch.clone() for batch in collector]
    collector.shutdown()
    assert len(batches) == 2
    data = torch.cat(batches, -1)
    assert data["next", "terminated"].any()
    assert data["next", "truncated"].any()
    check_transitions(data)


def test_reset_mask_changes_one_row(make_torchrl):
    env, other = make_torchrl(obs_mode="both"), make_torchrl(obs_mode="both")
    steps = [act(e.reset(), STAY) for e in (env, other)]
    td, untouched = env.step(steps[0])["next"], other.step(steps[1])["next"]
    td["_reset"] = torch.tensor([[False], [True], [False]])
    reset = env.reset(td)
    assert reset["observation"][:, 1].tolist() == [1.0, 0.0, 1.0]
    later = env.step(act(reset, STAY))["next"]
    expected = other.step(act(untouched, STAY))["next"]
    for row in (0, 2):
        assert torch.equal(later["pixels"][row], expected["pixels"][row])
        assert torch.equal(later["observation"][row], expected["observation"][row])
    assert later["observation"][1, 1] == 1.0


def test_resets_hand_out_what_the_step_has_drawn(make_torchrl):
    env = make_torchrl(obs_mode="both", episode_length=3)
    td = env.reset()
    calls = []
    reset = env._stateful.reset
    env._stateful.reset = lambda *args, **kwargs: calls.append(args) or reset(*args, **kwargs)
    for _ in range(12):
        _, td = env.step_and_maybe_reset(act(td))
    # A full reset counts the episodes that have begun already.
    for _ in range(3):
        td = env.step(act(td))["next"]
    assert td["done"].all()
    first = env.reset()
    assert not calls
    assert first["observation"][:, 1].tolist() == [0.0] * 3


def test_two_ends_may_be_reset_one_after_the_other(make_torchrl):
    options = {"obs_mode": "both", "episode_length": 1}
    env, together = make_torchrl(**options), make_torchrl(**options)
    expected = together.step(act(together.reset()))["next"]
    expected["_reset"] = expected["done"].clone()
    expected = together.reset(expected)
    td = env.step(act(env.reset()))["next"]
    td["_reset"] = torch.tensor([[True], [False], [False]])
    first = env.reset(td)
    assert first["done"].flatten().tolist() == [False, True, True]
    with pytest.raises(error.ResetNeeded, match=r"environment 1, 2 has ended.*'_reset'"):
        env.step(act(first.clone()))
    first["_reset"] = torch.tensor([[False], [True], [True]])
    both = env.reset(first)
    assert not both["done"].any()
    for key in ("pixels", "observation"):
        assert torch.equal(both[key], expected[key])


def test_partial_steps_leave_the_rest(make_torchrl):
    env, whole = make_torchrl(obs_mode="both"), make_torchrl(obs_mode="both")
    td = env.step(act(env.reset(), STAY))["next"]
    td["_step"] = torch.tensor([True, False, True])
    env.step(act(td, STAY))
    assert env.infos["episode_length"].tolist() == [2, 1, 2]
    # Environment 1 has taken one step less than the others.
    td = env.step(act(td.select("done"), STAY))["next"]
    assert td["observation"][:, 1].tolist() == [3.0, 2.0, 3.0]
    expected = whole.reset()
    for _ in range(3):
        expected = whole.step(act(expected, STAY))["next"]
    for row in (0, 2):
        assert torch.equal(td["pixels"][row], expected["pixels"][row])


def test_infos_of_environments_without_a_step(make_torchrl):
    env = make_torchrl()
    td = act(env.reset())
    td["_step"] = torch.tensor([True, False, True])
    env.step(td)
    assert env.infos["episode_length"].tolist() == [1, 0, 1]
    assert (env.infos["episode_return"] != 0).tolist() == [True, False, True]


def test_unstepped_environments_keep_what_they_had(make_torchrl):
    env = make_torchrl(obs_mode="both", episode_length=2)
    td = env.step(act(env.step(act(env.reset()))["next"]))
    assert td["next", "truncated"].all()
    ended = td["next"].copy()
    ended["_reset"] = torch.tensor([[True], [False], [True]])
    td = env.reset(ended.clone())
    td["_step"] = torch.tensor([True, False, True])
    after = env.step(act(td))["next"]
    assert after["done"].flatten().tolist() == [False, True, False]
    assert after["truncated"].flatten().tolist() == [False, True, False]
    assert after["reward"][1] == 0.0
    assert after["reward"][0] != 0.0
    for key in ("pixels", "observation"):
        assert torch.equal(after[key][1], ended[key][1])
    assert after["observation"][:, 1].tolist() == [1.0, 2.0, 1.0]


def test_tensors_are_the_buffers_that_jax_computed(make_torchrl):
    env = make_torchrl(obs_mode="both")
    stateful, seen = env._stateful, []
    for name in ("reset", "step"):
        method = getattr(stateful, name)

        def spy(*args, method=method, **kwargs):
            seen.append(method(*args, **kwargs))
            return seen[-1]

        setattr(stateful, name, spy)
    td = env.reset()
    assert td["pixels"].data_ptr() == seen[0]["obs"]["pixels"].unsafe_buffer_pointer()
    td = env.step(act(td))["next"]
    final = seen[1]["info"]["final_obs"]
    assert td["pixels"].data_ptr() == final["pixels"].unsafe_buffer_pointer()
    assert td["observation"].data_ptr() == final["state"].unsafe_buffer_pointer()
    assert td["reward"].data_ptr() == seen[1]["reward"].unsafe_buffer_pointer()


def test_episodes_that_begin_copy_no_pictures(make_torchrl):
    """TorchRL's own reset would choose each row of the batch between two tensors."""
    env = make_torchrl(obs_mode="both")
    td, seen = env.reset(), []
    step = env._stateful.step
    env._stateful.step = lambda *args, **options: seen.append(step(*args, **options)) or seen[-1]
    goes_right = torch.tensor([[0.0], [1.0], [0.0]])
    done = torch.zeros(3, 1, dtype=torch.bool)
    while not done.any():
        stepped, td = env.step_and_maybe_reset(act(td, goes_right))
        done = stepped["next", "done"]
    assert done.flatten().tolist() == [False, True, False]
    assert td.get("_reset", None) is None
    assert not td["done"].any()
    obs = seen[-1]["obs"]
    assert td["pixels"].data_ptr() == obs["pixels"].unsafe_buffer_pointer()
    assert td["observation"][:, 1].tolist() == np.asarray(obs["state"])[:, 1].tolist()
    assert torch.equal(td["pixels"][0], stepped["next", "pixels"][0])
    assert not torch.equal(td["pixels"][1], stepped["next", "pixels"][1])


def test_seeds(make_torchrl):
    def first(env):
        return env.reset()["observation"][:, 0].tolist()

    one = first(make_torchrl(obs_mode="state", seed=5))
    assert first(make_torchrl(obs_mode="state", seed=5)) == one
    assert first(make_torchrl(obs_mode="state", seed=6))[:2] == one[1:]
    # Seeds of any size, as TorchRL hands them on.
    assert first(make_torchrl(obs_mode="state", seed=2**32 + 5)) == one
    unseeded = []
    for _ in range(2):
        torch.manual_seed(3)
        unseeded.append(first(make_torchrl(obs_mode="state", seed=None)))
    assert unseeded[0] == unseeded[1]
    env = make_torchrl(obs_mode="state", seed=5)
    assert first(env) == one
    later = first(env)
    assert later != one
    env.set_seed(5)
    assert first(env) == one
    assert first(env) == later
    # Each environment begins its seed when it is next reset, be it alone.
    env.set_seed(5)
    td = env.step(act(env.reset()))["next"]
    env.set_seed(7)
    td["_reset"] = torch.tensor([[False], [True], [False]])
    alone = env.reset(td.clone())
    seven = first(make_torchrl(obs_mode="state", seed=7))
    assert alone["observation"][1, 0] == seven[1]
    td["_reset"] = torch.tensor([[True], [False], [True]])
    rest = env.reset(td)
    assert [rest["observation"][i, 0].item() for i in (0, 2)] == [seven[0], seven[2]]
    with pytest.raises(TypeError, match="must be an integer"):
        env.set_seed(1.5)
    with pytest.raises(TypeError, match=r"takes no seed; give seeds to set_seed\(\)"):
        env.reset(seed=3)


def test_transforms(make_torchrl):
    env = TransformedEnv(
        make_torchrl(frame_stack=1),
        Compose(
            ToTensorImage(),
            CatFrames(N=2, dim=-3, in_keys=["pixels"]),
            StepCounter(),
            RewardSum(),
        ),
    )
    check_env_specs(env)
    data = env.rollout(25, policy, break_when_any_done=False)
    assert data["pixels"].shape == (3, 25, 6, 12, 12)
    assert data["pixels"].dtype == torch.float32
    ended = data["next", "done"].squeeze(-1)
    assert ended.any()
    # The toy's reward is its position, and StepCounter starts anew with each episode.
    assert data["step_count"][:, 1:][ended[:, :-1]].eq(0).all()
    returns = data["next", "reward"].cumsum(1)[ended.cumsum(1) == 0]
    torch.testing.assert_close(data["next", "episode_reward"][ended.cumsum(1) == 0], returns)


def test_recording(make_torchrl, tmp_path):
    """Images of `render` end up in a video of TorchRL's recorder."""
    logger = CSVLogger("run", str(tmp_path), video_format="pt")
    env = TransformedEnv(
        make_torchrl(render_height=16, render_width=24),
        Compose(
            PixelRenderTransform(out_keys=["images"]),
            VideoRecorder(logger, tag="video", in_keys=["images"], skip=1),
        ),
    )
    env.rollout(5, policy)
    env.transform[-1].dump()
    (video,) = tmp_path.rglob("*.pt")
    frames = torch.load(video)
    # A first frame and five more, of all environments in a grid of two by two.
    assert frames.shape == (1, 6, 3, 2 * 16, 2 * 24)
    assert frames.dtype == torch.uint8
    assert frames.float().std() > 10


PROCESSES = """
from functools import partial
from torchrl.collectors import MultiSyncCollector
from pixelbrax_gym import TorchRLEnv

if __name__ == "__main__":
    options = {"height": 8, "width": 8, "obs_mode": "both"}
    make = partial(TorchRLEnv, "inverted_pendulum", 2, **options)
    collector = MultiSyncCollector([make, make], frames_per_batch=40, total_frames=80)
    collector.set_seed(0)
    for batch in collector:
        goes_on = ~batch["next", "done"][..., :-1, 0]
        after, before = batch["next", "observation"][..., :-1, :], batch["observation"][..., 1:, :]
        same_trajectory = batch["collector", "traj_ids"].diff(dim=-1) == 0
        assert (after[goes_on & same_trajectory] == before[goes_on & same_trajectory]).all()
        print(batch.numel())
    collector.shutdown()
"""


@pytest.mark.slow
def test_collectors_in_processes_of_their_own(tmp_path):
    script = tmp_path / "collect.py"
    script.write_text(PROCESSES)
    result = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, check=False, timeout=280
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == ["40", "40"]


def test_infos(make_torchrl):
    env = make_torchrl(obs_mode="state")
    td = env.reset()
    rewards = torch.zeros(3)
    for steps in (1, 2):
        td = env.step(act(td, STAY))["next"]
        rewards += td["reward"][:, 0]
        assert env.infos["episode_length"].tolist() == [steps] * 3
    torch.testing.assert_close(env.infos["episode_return"], rewards)
    assert not env.infos["non_finite"].any()


def test_use_out_of_order(make_torchrl):
    env = make_torchrl()
    with pytest.raises(error.ResetNeeded, match="reset"):
        env.step(TensorDict({"action": torch.zeros(3, 1)}, batch_size=[3]))
    env.reset()
    env.close()
    env.close()
    with pytest.raises(error.ClosedEnvironmentError, match="closed"):
        env.reset()


def test_missing_action(make_torchrl):
    env = make_torchrl(obs_mode="state")
    td = env.reset()
    with pytest.raises(ValueError, match=r"step\(\) needs an entry 'action'.*rand_action"):
        env.step(td)
    env.step(env.rand_action(td))


@pytest.mark.parametrize("dtype", [torch.float32, torch.int64])
@pytest.mark.parametrize("name", ["_reset", "_step"])
def test_masks_are_bool(make_torchrl, name, dtype):
    env = make_torchrl(obs_mode="state")
    td = env.rand_action(env.reset()).set(name, torch.ones(3, 1, dtype=dtype))
    with pytest.raises(TypeError, match=f"'{name}' must be an array or tensor of bool, got"):
        env._reset(td) if name == "_reset" else env._step(td)


@pytest.mark.parametrize("device", ["gpu", "cuda:77", "cuda"])
@pytest.mark.skipif(torch.cuda.is_available(), reason="the last one is there")
def test_device_that_is_not_there(device):
    with pytest.raises(ValueError, match=f"device='{device}' is not available"):
        pixelbrax_gym.TorchRLEnv(TASK, 2, device=device)


def test_repr_names_task_number_and_device(make_torchrl):
    expected = f"TorchRLEnv({TASK!r}, num_envs=3, device={{}})"
    assert repr(make_torchrl()) == expected.format(torch_device(jax.devices()[0]))
    assert repr(make_torchrl(device="cpu")) == expected.format("cpu")


def test_torchrls_own_gym_environment_takes_ours():
    from torchrl.envs import GymEnv

    env = GymEnv(ID, frame_skip=2, obs_mode="state", episode_length=20)
    plain = pixelbrax_gym.GymnasiumEnv(TASK, obs_mode="state", episode_length=20)
    # Seeding is a reset of its own there.
    env.set_seed(3), plain.reset(seed=3)
    td, (obs, _) = env.reset(), plain.reset()
    np.testing.assert_array_equal(td["observation"], obs)
    action = np.array([0.5], np.float32)
    td = env.step(td.set("action", torch.from_numpy(action)))["next"]
    steps = [plain.step(action) for _ in range(2)]
    np.testing.assert_array_equal(td["observation"], steps[-1][0])
    assert td["reward"].item() == pytest.approx(sum(step[1] for step in steps))


def test_pixel_specs_have_no_tensors():
    spec = torchrl_specs.observation_spec(
        pixelbrax_jax.make(TASK)[0].obs_spec, ("pixels",), 4096, torch.device("cpu")
    )
    assert spec["pixels"].shape == (4096, 84, 84, 9)
    for derived in (spec, spec.clone(), spec.to("cpu"), spec.expand(1, 4096), spec[:7]):
        assert derived["pixels"].space is None


def test_pixel_spec_behaves_as_unbounded():
    ours = PixelSpec((2, 4, 4, 3))
    theirs = Unbounded((2, 4, 4, 3), dtype=torch.uint8)
    assert ours == theirs
    assert ours == ours.clone()
    assert ours != PixelSpec((2, 4, 4, 6))
    for spec in (ours, theirs):
        assert spec.is_in(spec.rand())
        assert not spec.is_in(spec.rand().float())
        assert spec.zero().shape == (2, 4, 4, 3)
        assert spec.rand((5,)).shape == (5, 2, 4, 4, 3)
        assert spec.to(torch.float32).dtype == torch.float32
    assert type(ours.to(torch.float32)) is PixelSpec
    assert "PixelSpec" in repr(ours)
