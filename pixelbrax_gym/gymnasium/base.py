"""Share a spec and access to states between both of Gymnasium's environments."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

from gymnasium.envs.registration import EnvSpec

from pixelbrax_gym.stateful import StatefulEnv
from pixelbrax_jax.plain import to_plain
from pixelbrax_jax.types import EnvState


class StatefulAdapter:
    """Base of Gymnasium's environments around a ``StatefulEnv``."""

    _stateful: StatefulEnv
    _spec: EnvSpec | None = None

    def get_state(self) -> EnvState:
        """Return the current ``EnvState``, with a leading axis N for many environments.

        It can be pickled. ``reset(options={"state": state})`` continues from it bit for bit, except
        for the count of a ``TimeLimit`` around the environment.

        Raises:
            ResetNeeded: before the first reset.
        """
        return self._stateful.get_state()

    def set_state(self, state: EnvState) -> None:
        """Continue from a state of ``get_state`` of an environment with the same options.

        A single environment also takes the states of ``PixelEnv``.

        Raises:
            TypeError: ``state`` is not an ``EnvState``.
            ValueError: ``state`` does not fit this environment.
        """
        self._stateful.set_state(state)

    @property
    def spec(self) -> EnvSpec | None:
        """Spec of an equal environment, with the time limit in calls of ``step``."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is None:
            self._spec = None
            return
        stateful = self._stateful
        spec = copy.copy(spec)
        spec.max_episode_steps = stateful.max_episode_steps
        spec.kwargs = dict(spec.kwargs)
        spec.kwargs.pop("max_episode_steps", None)
        # `make_vec` passes the limit of a spec to the environments, `make` to a wrapper.
        if stateful.is_limited or not stateful.single:
            spec.kwargs["episode_length"] = stateful.episode_length
        if list(_unstorable(spec.kwargs)):
            spec.__class__ = _UnstorableSpec
        else:
            spec.kwargs = to_plain(spec.kwargs)
        self._spec = spec


class _UnstorableSpec(EnvSpec):
    """A spec with options that cannot be written as JSON."""

    def to_json(self) -> str:
        names = ", ".join(f"{name}={value!r:.60}" for name, value in _unstorable(self.kwargs))
        raise ValueError(
            f"the spec of {self.id} cannot be written as JSON because of {names}; give clips as a "
            "folder, and other objects by their names."
        )


def _unstorable(kwargs: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in kwargs.items():
        try:
            to_plain(value)
        except ValueError:
            yield name, value
