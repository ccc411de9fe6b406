"""Every adapter behind one interface, so that one test is about all of them."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium
import jax
import numpy as np
import torch

import pixelbrax_gym
from tests.gym.conftest import ID, SIZE, TASK

ACTIONS = np.array([[-0.2], [0.9], [1.0]], np.float32)
"""Ball 0 stays until the time limit; 1 and 2 leave the line, one before the other."""

OPTIONS = SIZE | {"obs_mode": "both", "episode_length": 20}


class Event(NamedTuple):
    """What one environment showed: the first observation of an episode, or that after a step."""

    row: int
    is_first: bool
    obs: Any
    reward: float = 0.0
    terminated: bool = False
    truncated: bool = False
    length: int = 0


def row_of(tree: Any, i: int) -> Any:
    """A copy of one environment's part, by NumPy."""
    return jax.tree.map(lambda x: np.array(np.asarray(x)[i]), tree)


class Adapter:
    """Three environments of one adapter; ``env`` may be replaced by a copy of it."""

    def __init__(self, env: Any) -> None:
        self.env = env

    @property
    def snapshot(self) -> Any:
        """What is kept between two calls."""
        return getattr(self.env, "unwrapped", self.env)._stateful._snapshot

    @property
    def ended(self) -> np.ndarray:
        """Where an episode has ended and no other one has begun."""
        return np.atleast_1d(np.asarray(self.snapshot.ended))

    def held(self) -> bytes:
        """The state that the environment holds, and what the adapter keeps beside it."""
        snapshot = self.snapshot
        begun = self.env._begun[1] if isinstance(self, TorchRL) else ()
        kept = (*snapshot.packed, snapshot.ended, begun)
        return b"".join(np.asarray(array).tobytes() for array in kept)

    def reset(self, seed: int = 0) -> Any:
        """Reset all; return what the environment does."""
        return self.env.reset(seed=seed)

    def first(self, returned: Any) -> list[Event]:
        """Events of a reset of all, from what it returned."""
        return [Event(i, True, row_of(returned[0], i)) for i in range(3)]

    def call(self, actions: np.ndarray = ACTIONS) -> tuple[list[Event], Any]:
        """Step, or reset what has ended, as one has to; events, and what the call returned."""
        raise NotImplementedError


class Single(Adapter):
    def __init__(self, **options: Any) -> None:
        super().__init__(gymnasium.make(ID, **(OPTIONS | options)))

    def first(self, returned: Any) -> list[Event]:
        return [Event(0, True, jax.tree.map(np.array, returned[0]))]

    def call(self, actions: np.ndarray = ACTIONS) -> tuple[list[Event], Any]:
        if self.ended[0]:
            returned = self.env.reset()
            return self.first(returned), returned
        obs, *rest, info = returned = self.env.step(actions[0])
        obs = jax.tree.map(np.array, obs)
        return [Event(0, False, obs, *rest, info["episode_length"])], returned


class Vector(Adapter):
    def __init__(self, mode: str = "next_step", **options: Any) -> None:
        options = OPTIONS | {"autoreset_mode": mode} | options
        super().__init__(gymnasium.make_vec(ID, num_envs=3, **options))
        self.mode = mode

    def call(self, actions: np.ndarray = ACTIONS) -> tuple[list[Event], Any]:
        ended = self.ended
        if self.mode == "disabled" and ended.any():
            returned = self.env.reset(options={"reset_mask": ended})
            return [self.first(returned)[i] for i in np.flatnonzero(ended)], returned
        obs, reward, terminated, truncated, infos = returned = self.env.step(actions)
        firsts, events = self.first(returned), []
        for i in range(3):
            results = float(reward[i]), bool(terminated[i]), bool(truncated[i])
            length = int(infos["episode_length"][i])
            if self.mode == "next_step" and ended[i]:
                assert results == (0.0, False, False)
                assert length == 0
                events.append(firsts[i])
            elif self.mode == "same_step" and (results[1] or results[2]):
                assert length == 0
                length = int(infos["final_info"]["episode_length"][i])
                last = infos["final_obs"]
                last = row_of(last, i) if isinstance(last, dict) else last[i]
                events += [Event(i, False, last, *results, length), firsts[i]]
            else:
                events.append(Event(i, False, row_of(obs, i), *results, length))
        return events, returned


class SB3(Adapter):
    def __init__(self, **options: Any) -> None:
        super().__init__(pixelbrax_gym.SB3VecEnv(TASK, 3, **(OPTIONS | options)))

    def reset(self, seed: int = 0) -> Any:
        self.env.seed(seed)
        return (self.env.reset(),)

    def call(self, actions: np.ndarray = ACTIONS) -> tuple[list[Event], Any]:
        obs, rewards, dones, infos = returned = self.env.step(actions)
        firsts, events = self.first(returned), []
        for i, info in enumerate(infos):
            assert ("terminal_observation" in info) == dones[i]
            truncated = info["TimeLimit.truncated"]
            results = float(rewards[i]), bool(dones[i]) and not truncated, truncated
            last = info["terminal_observation"] if dones[i] else row_of(obs, i)
            events.append(Event(i, False, last, *results, info.get("episode_length", -1)))
            events += [firsts[i]] if dones[i] else []
        return events, returned


class TorchRL(Adapter):
    def __init__(self, **options: Any) -> None:
        super().__init__(pixelbrax_gym.TorchRLEnv(TASK, 3, **(OPTIONS | options)))

    @property
    def ended(self) -> np.ndarray:
        return self.env._begun[1]

    def reset(self, seed: int = 0) -> Any:
        self.env.set_seed(seed)
        return (self._named(self.env.reset()),)

    def call(self, actions: np.ndarray = ACTIONS) -> tuple[list[Event], Any]:
        ended = self.ended
        given = self.env.full_done_spec.zero()
        if ended.any():
            returned = self._named(
                self.env.reset(given.set("_reset", torch.tensor(ended[:, None])))
            )
            return [self.first((returned,))[i] for i in np.flatnonzero(ended)], returned
        td = self.env.step(given.set("action", torch.tensor(actions)))["next"]
        names = ("reward", "terminated", "truncated")
        results = zip(*(td[name].flatten().tolist() for name in names), strict=True)
        lengths = self.env.infos["episode_length"].tolist()
        obs = self._named(td)
        return [
            Event(i, False, row_of(obs, i), *result, lengths[i]) for i, result in enumerate(results)
        ], dict(td.items())

    @staticmethod
    def _named(td: Any) -> Any:
        """Observations by the names that the other adapters have for them."""
        return {"pixels": td["pixels"], "state": td["observation"]}


ADAPTERS = {
    "single": Single,
    "numpy": Vector,
    "torch": lambda **options: Vector("same_step", output="torch", **options),
    "jax": lambda **options: Vector("disabled", output="jax", **options),
    "sb3": SB3,
    "torchrl": TorchRL,
}
"""Each with another autoreset mode, as far as there is a choice."""


def as_bytes(returned: Any) -> Any:
    """The bits of all that a call returned."""

    def bits(leaf: Any) -> Any:
        array = np.asarray(leaf)
        return as_bytes(list(array)) if array.dtype == object else array.tobytes()

    return jax.tree.map(bits, returned)
