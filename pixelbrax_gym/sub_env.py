"""Represent one of many environments in frameworks that address them one by one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

from pixelbrax_jax.validation import suggest


class SubEnv:
    """A stand-in for environment ``index`` of a ``GymnasiumVectorEnv`` or ``SB3VecEnv``.

    It stores the attributes that are set on it; the environment itself ignores them.
    """

    def __init__(
        self,
        owner: Any,
        index: int,
        observation_space: gymnasium.Space,
        action_space: gymnasium.Space,
    ) -> None:
        """Build the stand-in; ``owner.get_images`` returns N images."""
        self.owner, self.index, self.render_mode = owner, index, owner.render_mode
        self.observation_space, self.action_space = observation_space, action_space

    def __getattr__(self, name: str) -> Any:
        """Return ``metadata`` or ``spec`` of the owner unless they were set here."""
        if name in ("metadata", "spec"):
            return getattr(self.owner, name, None)
        names = [known for known in dir(type(self)) if not known.startswith("_")]
        raise AttributeError(f"environments have no attribute {name!r}.{suggest(name, names)}")

    # As of an environment without wrappers.
    unwrapped = gymnasium.Env.unwrapped
    has_wrapper_attr = gymnasium.Env.has_wrapper_attr
    get_wrapper_attr = gymnasium.Env.get_wrapper_attr
    set_wrapper_attr = gymnasium.Env.set_wrapper_attr

    def render(self) -> np.ndarray | None:
        """Return the environment's image; renders all environments."""
        return self.owner.get_images()[self.index]


def call_sub_envs(sub_envs: Sequence[SubEnv], name: str, *args: Any, **kwargs: Any) -> list[Any]:
    """Call a method of each sub-environment, or return the attribute of that name."""
    if name == "render" and sub_envs:
        # All images are rendered at once.
        images = sub_envs[0].owner.get_images()
        return [images[sub_env.index] for sub_env in sub_envs]
    values = [getattr(sub_env, name) for sub_env in sub_envs]
    return [value(*args, **kwargs) if callable(value) else value for value in values]
