"""What both of Gymnasium's environments have: a spec, and states that are taken and given back."""

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
        """Return the present state, of many environments with a leading axis N.

        Returns:
            An ``EnvState`` of arrays that nothing writes to, with all that decides how the episode
            and the later ones go on, but for a ``TimeLimit`` around the environment. It can be
            pickled, and ``reset(options={"state": state})`` goes on from it to the bit.

        Raises:
            ResetNeeded: before the first reset.
            ClosedEnvironmentError: after ``close`` of many environments.
        """
        return self._stateful.get_state()

    def set_state(self, state: EnvState) -> None:
        """Go on from a given state, as ``reset(options={"state": state})`` does.

        Args:
            state: what ``get_state`` returned here or of another environment of the same options;
                or, of one environment, what ``PixelEnv.reset`` or ``PixelEnv.step`` did.

        Raises:
            TypeError: it is no ``EnvState``.
            ValueError: it is of another environment; the message names the first difference.
            ClosedEnvironmentError: after ``close`` of many environments.
        """
        self._stateful.set_state(state)

    @property
    def spec(self) -> EnvSpec | None:
        """What Gymnasium knows of the environment, from which an equal one can be made.

        The time limit is in calls of ``step``, options are what JSON has.
        """
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
        # `make_vec` hands the limit of a spec to the environments, `make` to a wrapper.
        if stateful.is_limited or not stateful.single:
            spec.kwargs["episode_length"] = stateful.episode_length
        if list(_unstorable(spec.kwargs)):
            spec.__class__ = _UnstorableSpec
        else:
            spec.kwargs = to_plain(spec.kwargs)
        self._spec = spec


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


def _unstorable(kwargs: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in kwargs.items():
        try:
            to_plain(value)
        except ValueError:
            yield name, value
