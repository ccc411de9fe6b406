"""One of many environments, for frameworks that ask each for its attributes and methods."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

from pixelbrax_jax.validation import suggest


class SubEnv:
    """Stands for one environment of a ``GymnasiumVectorEnv`` or ``SB3VecEnv``.

    There is one object for all environments, and no object for each. What is set on a ``SubEnv`` is
    kept there; the environments themselves know nothing of it.

    Attributes:
        owner: the environment of all.
        index: which one it is.
        render_mode: None or ``"rgb_array"``.
        observation_space: of one environment.
        action_space: of one environment.
        metadata: of all environments.
        spec: of all environments; None unless Gymnasium made them.
    """

    def __init__(
        self,
        owner: Any,
        index: int,
        observation_space: gymnasium.Space,
        action_space: gymnasium.Space,
    ) -> None:
        """Make the stand-in of environment ``index``; ``owner.get_images`` returns N images."""
        self.owner, self.index, self.render_mode = owner, index, owner.render_mode
        self.observation_space, self.action_space = observation_space, action_space

    def __getattr__(self, name: str) -> Any:
        """Return what all environments share, as long as this one has none of its own."""
        if name in ("metadata", "spec"):
            return getattr(self.owner, name, None)
        names = [known for known in dir(type(self)) if not known.startswith("_")]
        raise AttributeError(f"environments have no attribute {name!r}.{suggest(name, names)}")

    @property
    def unwrapped(self) -> SubEnv:
        """Return this object: there is nothing around it."""
        return self

    def has_wrapper_attr(self, name: str) -> bool:
        """Return whether there is such an attribute, as Gymnasium's environments do."""
        return hasattr(self, name)

    def get_wrapper_attr(self, name: str) -> Any:
        """Return the attribute of that name, as Gymnasium's environments do."""
        return getattr(self, name)

    def set_wrapper_attr(self, name: str, value: Any, *, force: bool = True) -> bool:
        """Set the attribute of that name, as Gymnasium's environments do.

        Without ``force`` only one that is there already; returns whether it was set.
        """
        if not force and not hasattr(self, name):
            return False
        setattr(self, name, value)
        return True

    def render(self) -> np.ndarray | None:
        """Return the environment's image; draws those of all."""
        return self.owner.get_images()[self.index]


def call_sub_envs(sub_envs: Sequence[SubEnv], name: str, *args: Any, **kwargs: Any) -> list[Any]:
    """Return an attribute of each sub-environment, or what it returns if it can be called."""
    if name == "render" and sub_envs:
        # Drawn once for all, not once for each.
        images = sub_envs[0].owner.get_images()
        return [images[sub_env.index] for sub_env in sub_envs]
    values = [getattr(sub_env, name) for sub_env in sub_envs]
    return [value(*args, **kwargs) if callable(value) else value for value in values]
