"""What Gymnasium knows of an environment, and its time limits around one."""

from __future__ import annotations

import copy
import sys
from types import FrameType
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import TimeLimit

from pixelbrax_gym.stateful import StatefulEnv
from pixelbrax_jax.plain import to_plain


class _UnstorableSpec(EnvSpec):
    """A spec with options that JSON has nothing for."""

    def to_json(self) -> str:
        """Refuse.

        Raises:
            ValueError: names the options.
        """
        names = ", ".join(f"{name}={value!r:.60}" for name, value in _unstorable(self.kwargs))
        raise ValueError(
            f"the spec of {self.id} does not go into JSON, for there is nothing there for {names}; "
            "give a folder in place of clips, or the name of what is given as an object."
        )


def complete_spec(spec: EnvSpec | None, stateful: StatefulEnv, limited: bool) -> EnvSpec | None:
    """Return Gymnasium's description of an environment, from which an equal one can be made.

    Args:
        spec: what Gymnasium knows of the environment.
        stateful: what was made.
        limited: whether ``episode_length`` is among the options of the spec.

    Returns:
        The spec with the time limit, and with options as what JSON has.
    """
    if spec is None:
        return None
    spec = copy.copy(spec)
    spec.max_episode_steps = stateful.max_episode_steps
    spec.kwargs = dict(spec.kwargs)
    spec.kwargs.pop("max_episode_steps", None)
    if limited:
        spec.kwargs["episode_length"] = stateful.episode_length
    if list(_unstorable(spec.kwargs)):
        spec.__class__ = _UnstorableSpec
    else:
        spec.kwargs = to_plain(spec.kwargs)
    return spec


def time_limit_around(env: gymnasium.Env) -> int | None:
    """Return the limit of the ``TimeLimit`` wrappers through which ``env`` is reset.

    ``gymnasium.make`` tells its ``max_episode_steps`` to such a wrapper alone, so that an
    environment with a limit of its own cannot know otherwise that a longer one was asked for.

    Args:
        env: an environment, of which ``reset`` is running.

    Returns:
        Calls of ``step``, the least of several; None without such a wrapper.
    """
    limits: list[int] = []
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        # Of no other frame: to look at its variables may keep them alive.
        if frame.f_code is TimeLimit.reset.__code__:
            wrapper = frame.f_locals["self"]
            if wrapper.unwrapped is env:
                limits.append(wrapper._max_episode_steps)
        frame = frame.f_back
    return min(limits, default=None)


def _unstorable(kwargs: dict[str, Any]) -> Any:
    for name, value in kwargs.items():
        try:
            to_plain(value)
        except ValueError:
            yield name, value
