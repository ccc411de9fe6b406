"""Play a suite of levels with any policy through the Gymnasium vector environment."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from functools import partial
from os import PathLike
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pixelbrax_gym.generalisation.scores import LEFT_OUT, Scores, play
from pixelbrax_gym.gymnasium.vector_env import GymnasiumVectorEnv
from pixelbrax_jax import EnvParams, VectorPixelEnv
from pixelbrax_jax.config import ENV_OPTIONS, env_config
from pixelbrax_jax.flags import default_flags
from pixelbrax_jax.generalisation.making import LevelEnv, Levels, make_levels
from pixelbrax_jax.generalisation.suites import EPISODES, SUITES
from pixelbrax_jax.validation import check_choice, check_finite

Policy = Callable[[Any], Any]

_OWN_OPTIONS = ("episodes", "clips", "output", "output_dir", "report", "success_return")


def evaluate_suite(
    policy: Policy | Mapping[str, Policy],
    task: str,
    suite: str,
    *,
    episodes: int | None = None,
    clips: str | PathLike[str] | None = None,
    output: str = "numpy",
    output_dir: str | PathLike[str] | None = None,
    report: Callable[[str], object] = lambda _: None,
    success_return: float | None = None,
    **options: Any,
) -> Scores:
    """Play every level of a suite with a policy; ``print(scores.markdown())`` shows the table.

    ``policy(obs)`` gets the observations of all episodes of a level at once, (E, H, W, 3 K) uint8
    pixels unless ``obs_mode`` says otherwise, and returns (E, A) actions in [-1, 1], floating
    point. The episodes are those of ``pixelbrax evaluate --suite``, the same in every call.

    Args:
        policy: the policy; or several by name, which are the seeds of one agent.
        task: one of ``pixelbrax_jax.list_envs()``.
        suite: ``dmcgb``, ``dmcgb2``, ``dcs``, ``paper``, ``subtle`` or ``axes``.
        episodes: number E of episodes of each level; None for the suite's.
        clips: folder of the videos, or ``"procedural"``, for suites that show any.
        output: type of the observations, ``"numpy"``, ``"torch"`` or ``"jax"``.
        output_dir: folder for ``returns.json``, with the return of every episode, ``table.csv`` and
            ``levels.png``. Levels that the file has are not played again, with a UserWarning; it
            knows policies by name alone.
        report: takes a line after each level.
        success_return: an episode with at least this return is a success; None for the task's, with
            which ``episode_length`` and ``reward_preset`` must be the usual ones.
        **options: other options of ``pixelbrax_jax.make``, such as ``action_repeat``.

    Raises:
        ValueError: the suite is unknown or has no levels for the task, the policy returns another
            shape or NaN, the folder is a file or has returns of other options, or
            ``success_return`` is not finite.
        FileNotFoundError: clips are missing; the message says where to get them.
        TypeError: an option is unknown or the suite's own, or a policy cannot be called or has a
            name that is no string.
        ImportError: ``output_dir`` is given and Pillow is missing.
    """
    policies = policy if isinstance(policy, Mapping) else {"policy": policy}
    for name, one in policies.items():
        if not isinstance(name, str):
            raise TypeError(f"names of policies must be strings, got {name!r}.")
        if not callable(one):
            raise TypeError(f"policy {name!r} must be a function of observations, got {one!r}.")
    if not policies:
        raise ValueError("policy must have at least one policy, got an empty mapping.")
    check_choice("suite", suite, SUITES)
    if success_return is not None:
        check_finite("success_return", success_return)
    if own := [name for name in LEFT_OUT if name in options]:
        raise TypeError(f"{own[0]} is decided by the levels of a suite; leave it out.")
    config = env_config(task, options, _OWN_OPTIONS)
    levels = make_levels(config, suite, episodes, clips, report)
    # Levels with one program share their environments.
    made: dict[Any, GymnasiumVectorEnv] = {}
    num_played = 0

    def play_level(level: LevelEnv, policy: Policy) -> np.ndarray:
        nonlocal num_played
        num_played += 1
        if level.env not in made:
            made[level.env] = make_level_envs(levels, level, levels.episodes, output)
        return _returns(made[level.env], level.params, policy)

    players = {name: partial(play_level, policy=one) for name, one in policies.items()}
    scores = play(levels, players, output_dir, report, success_return)
    if num_kept := len(levels.levels) * len(players) - num_played:
        warnings.warn(
            f"{num_kept} levels of {', '.join(players)} were not played, because {output_dir} has "
            "returns of policies with these names: give another policy another name or folder.",
            stacklevel=2,
        )
    return scores


def make_level_envs(
    levels: Levels, one: LevelEnv, num_envs: int, output: str, **changes: Any
) -> GymnasiumVectorEnv:
    """Make the vector environment of a level with some options changed."""
    options: dict[str, Any] = {
        name: getattr(levels.config, name) for name in ENV_OPTIONS if name not in LEFT_OUT
    }
    options["distractors"] = one.env.distractors
    options["clips"] = levels.bank if one.level.clips else None
    return GymnasiumVectorEnv(levels.config.task, num_envs, output=output, **options | changes)


def begin(envs: GymnasiumVectorEnv, keys: jax.Array, params: EnvParams) -> Any:
    """Start the episodes of these keys, or of one for all, and return the observations."""
    # Levels differ in the parameters that a vector environment passes to its programs.
    envs._stateful.params = params
    state, _ = VectorPixelEnv(envs._stateful.env, envs.num_envs).reset(keys, params)
    return envs.reset(options={"state": state})[0]


def _returns(envs: GymnasiumVectorEnv, params: EnvParams, policy: Policy) -> np.ndarray:
    """Play an episode in each of E environments; return their (E,) returns."""
    with default_flags():
        key = jax.random.key(EPISODES)
    obs = begin(envs, key, params)
    shape = (envs.num_envs, envs._stateful.env.action_size)
    over, returns = np.zeros(shape[0], bool), np.zeros(shape[0])
    while not over.all():
        actions = checked(policy(obs), shape)
        obs, _, terminated, truncated, infos = envs.step(actions)
        # Later episodes of an environment are ignored.
        returns = np.where(over, returns, numpy_of(infos["episode_return"]))
        over |= numpy_of(terminated) | numpy_of(truncated)
    return returns


def checked(actions: Any, shape: tuple[int, ...], episodes: np.ndarray | None = None) -> Any:
    """Return a policy's actions; another shape than (E, A) is a ValueError, and so is NaN.

    ``episodes`` are the numbers of the rows' episodes, by default 0 to E - 1.
    """
    if isinstance(actions, tuple):
        raise ValueError(
            "the policy must return an array of actions, got a tuple; of what predict of "
            "Stable-Baselines3 returns, take the first."
        )
    if (got := tuple(np.shape(actions))) != shape:
        raise ValueError(
            f"the policy must return actions of shape {shape}, a row for each of {shape[0]} "
            f"episodes, got {got}."
        )
    values = numpy_of(actions)
    # The environment refuses other dtypes.
    if (
        jnp.issubdtype(values.dtype, jnp.floating)
        and (missing := np.isnan(values).any(axis=1)).any()
    ):
        numbers = np.arange(len(missing)) if episodes is None else episodes
        names = ", ".join(map(str, sorted({*numbers[missing].tolist()})))
        raise ValueError(f"the policy's actions of episodes {names} contain NaN.")
    return actions


def numpy_of(array: Any) -> np.ndarray:
    """Return an array of NumPy, JAX or torch in host memory; bfloat16 becomes float32."""
    if hasattr(array, "detach"):
        array = array.detach().cpu()
        array = (array.float() if array.is_floating_point() else array).numpy()
    return np.asarray(array)
