"""Load a trained agent from its run's folder or the package, and export its policy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import jax

from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.config import TrainConfig, make_env
from pixelbrax_jax.agents.registry import ALGORITHMS
from pixelbrax_jax.agents.rollout import split_obs
from pixelbrax_jax.agents.runner.checkpoint import (
    CheckpointError,
    best_steps,
    read_about,
    read_networks,
)
from pixelbrax_jax.agents.runner.programs import Runs
from pixelbrax_jax.agents.runner.settings import (
    OF_RUNS,
    clip_digests,
    former_settings,
    unknown_settings,
)
from pixelbrax_jax.agents.runner.splits import plays_clips
from pixelbrax_jax.agents.train_state import Networks
from pixelbrax_jax.distractors.presets import as_tuple
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.flags import under_default_flags
from pixelbrax_jax.generalisation.making import UNDISTURBED
from pixelbrax_jax.paths import in_home, replacing
from pixelbrax_jax.policy import Policy, load_policy, read_pretrained


@dataclass(frozen=True, eq=False)
class Pretrained:
    """A policy of the package, which contains its parameters."""

    config: TrainConfig
    policy: Policy
    acting: ClassVar[tuple[str, ...]] = ()

    @under_default_flags
    def act(self, networks: Networks, pixels: jax.Array) -> jax.Array:
        """Return mean actions; without networks, because the policy contains them."""
        del networks
        return self.policy(pixels)


Player = Algorithm | Pretrained
"""Chooses actions: an ``Algorithm`` with its networks, or a policy of the package."""


@dataclass(frozen=True)
class Trained:
    """The networks of a run after ``steps`` control steps, or a policy of the package.

    ``clips`` are digests of the training's clips, or None if the run did not store them.
    """

    algorithm: Player
    networks: Networks
    steps: int
    seed: int = 0
    clips: Sequence[str] | None = None


def load_pretrained(name: str) -> Trained:
    """Load a policy of the package by a name of ``pixelbrax_jax.list_pretrained()``."""
    about = read_pretrained(name)
    player = Pretrained(load_config(about), load_policy(name))
    return Trained(player, {}, about["steps"], about["config"].get("seed", 0))


def load_trained(
    folder: str | Path, *, steps: int | None = None, best: bool = False, run: int = 0
) -> Trained:
    """Load a checkpoint from the folder of a training run: of ``steps``, the best or the latest.

    ``run`` is the index of the run, from 0, if several were trained together.
    """
    checkpoints = in_home(folder) / "checkpoints"
    if best and steps is not None:
        raise ValueError(f"give best or steps, not both; got steps={steps}.")
    if best and (steps := best_steps(checkpoints)) is None:
        raise CheckpointError(
            f"no checkpoint in {checkpoints} has a score yet; omit --best to load the latest."
        )
    about = read_about(checkpoints, steps)
    config = load_config(about)
    num_seeds = about["config"].get("seeds", 1)
    if not 0 <= run < num_seeds:
        raise ValueError(f"run must be from 0 to {num_seeds - 1}, got {run}.")
    # The networks depend on the observations of training, which may include the state.
    env, params = make_env(config, **UNDISTURBED)
    algorithm = ALGORITHMS[about["algorithm"]](config, VectorPixelEnv(env, config.num_envs))
    runs = Runs(algorithm, num_seeds)
    template = runs.template(params).networks
    networks = runs.split(read_networks(checkpoints, template, about["steps"]))[run]
    seed = about["config"].get("seed", 0) + run
    return Trained(algorithm, networks, about["steps"], seed, about.get("clips"))


def num_runs(folder: str | Path) -> int:
    """Return the number of runs in the latest checkpoint of an output folder."""
    return read_about(in_home(folder) / "checkpoints")["config"].get("seeds", 1)


def with_clips(agent: Trained, clips: str | None) -> tuple[TrainConfig, Sequence[str] | None]:
    """Return an agent's settings with other ``clips``, if any, and digests of its training's clips.

    The digests are None if they are neither stored nor computable, because the folder is missing.
    """
    config, shown = agent.algorithm.config, agent.clips
    if clips is None:
        return config, shown
    if not plays_clips(config):
        raise ValueError(
            f"--clips {clips} needs a run with a video distractor; its distractors are "
            f"{', '.join(map(str, as_tuple(config.env.distractors))) or 'none'}."
        )
    if shown is None:
        with suppress(FileNotFoundError):
            shown = clip_digests(make_env(config)[1].clips)
    return config.replace(clips=clips), shown


def load_config(about: Mapping[str, Any]) -> TrainConfig:
    """Read the settings in a checkpoint's data; raise a CheckpointError if some are unknown."""
    if about["algorithm"] not in ALGORITHMS:
        raise CheckpointError(
            f"the checkpoint's algorithm must be one of {', '.join(ALGORITHMS)}, got "
            f"{about['algorithm']!r}; read your own algorithm's with "
            "pixelbrax_jax.agents.runner.checkpoint.read_networks."
        )
    kind = ALGORITHMS[about["algorithm"]].config_class
    former = former_settings(kind)
    if unknown := unknown_settings(about, former):
        raise CheckpointError(unknown.strip())
    stored = former | about["config"]
    return kind().replace(**{name: stored[name] for name in former if name not in OF_RUNS})


@contextmanager
def _without_locations() -> Iterator[None]:
    """Omit paths of source files from programs, which may be shared."""
    name = "jax_traceback_in_locations_limit"
    limit = jax.config.values[name]
    jax.config.update(name, 0)
    try:
        yield
    finally:
        jax.config.update(name, limit)


def save_policy(algorithm: Algorithm, networks: Networks, path: str | Path) -> Path:
    """Export the mean actions of a policy to a file, and return its path.

    The file contains program and parameters, and needs only JAX on CPU, CUDA or TPU:
    ``jax.export.deserialize(bytes).call(pixels)`` for any number of observations.
    """
    spec, _ = split_obs(algorithm.envs.env.obs_spec)
    acting = {name: networks[name] for name in algorithm.acting}
    (batch,) = jax.export.symbolic_shape("batch")
    act = jax.export.export(
        jax.jit(lambda pixels: algorithm.act(acting, pixels)), platforms=("cpu", "cuda", "tpu")
    )
    with _without_locations():
        exported = act(jax.ShapeDtypeStruct((batch, *spec.shape), spec.dtype))
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part:
        part.write_bytes(exported.serialize())
    return path
