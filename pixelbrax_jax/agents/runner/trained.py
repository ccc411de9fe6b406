"""A trained agent: read from the folder of its run, or from the package; its policy in a file."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp

from pixelbrax_jax.agents.algorithm import Algorithm
from pixelbrax_jax.agents.config import TrainConfig, make_env
from pixelbrax_jax.agents.registry import ALGORITHMS
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
from pixelbrax_jax.agents.runner.splits import WITHOUT_DISTRACTORS, splits_of
from pixelbrax_jax.agents.train_state import Networks
from pixelbrax_jax.distractors.presets import as_tuple
from pixelbrax_jax.envs.vector import VectorPixelEnv
from pixelbrax_jax.flags import under_default_flags
from pixelbrax_jax.policy import Policy, load_policy, read_pretrained

PLATFORMS = ("cpu", "cuda", "tpu")
"""Devices that an exported policy runs on."""


class Player(Protocol):
    """What chooses actions; hashable. Every ``Algorithm`` does."""

    @property
    def acting(self) -> tuple[str, ...]:
        """As ``Algorithm.acting``."""

    @property
    def config(self) -> TrainConfig:
        """Settings of its training."""

    def act(self, networks: Networks, pixels: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """As ``Algorithm.act``."""


@dataclass(frozen=True, eq=False)
class Pretrained:
    """A policy with its parameters within."""

    config: TrainConfig
    policy: Policy
    acting: ClassVar[tuple[str, ...]] = ()

    @under_default_flags
    def act(self, networks: Networks, pixels: jax.Array, key: jax.Array | None = None) -> jax.Array:
        """Return mean actions; there are no others, so that a key is a ValueError."""
        del networks
        if key is not None:
            raise ValueError("a pretrained policy has mean actions alone, got a key.")
        return self.policy(pixels)


@dataclass(frozen=True)
class Trained:
    """One run's networks at one checkpoint, or a policy that comes with the package.

    Attributes:
        algorithm: with the run's settings; its ``act`` plays.
        networks: for ``act``, for an ``Evaluator`` and for ``save_policy``.
        steps: control steps of the checkpoint.
        seed: of the run.
        clips: digests of the clips that it was trained on, for ``make_split``; None where they are
            not stored, and the settings' own are taken.
    """

    algorithm: Player
    networks: Networks
    steps: int
    seed: int = 0
    clips: tuple[str, ...] | None = None


def load_pretrained(name: str) -> Trained:
    """Return a policy that comes with the package, one of ``pixelbrax_jax.list_pretrained()``."""
    about = read_pretrained(name)
    player = Pretrained(load_config(about), load_policy(name))
    return Trained(player, {}, about["steps"], about["config"].get("seed", 0))


def load_agent(
    folder: str | Path | None,
    pretrained: str | None,
    *,
    steps: int | None = None,
    best: bool = False,
    run: int = 0,
) -> Trained:
    """Return an agent from a folder, as `load_trained`, or of a name, as `load_pretrained`."""
    if folder is not None and pretrained is None:
        return load_trained(folder, steps=steps, best=best, run=run)
    if folder is not None or pretrained is None:
        raise ValueError("give the folder of a run, or --pretrained and a name: one of the two.")
    if steps is not None or best or run:
        raise ValueError("--steps, --best and --run choose of a run's folder, not of --pretrained.")
    return load_pretrained(pretrained)


def load_trained(
    folder: str | Path, *, steps: int | None = None, best: bool = False, run: int = 0
) -> Trained:
    """Read the networks of a checkpoint.

    Args:
        folder: output folder of a training run.
        steps: of which checkpoint; None takes the latest.
        best: whether instead the best checkpoint is taken.
        run: which of several runs that were trained together, from 0.

    Raises:
        CheckpointError: there is no such checkpoint, or its algorithm is unknown here.
        ValueError: an option is out of range.
    """
    checkpoints = Path(folder) / "checkpoints"
    if best and steps is not None:
        raise ValueError(f"give best or steps, not both; got steps={steps}.")
    if best:
        steps = best_steps(checkpoints)
        if steps is None:
            raise CheckpointError(
                f"no checkpoint in {checkpoints} has a score yet; without --best the latest is "
                "taken."
            )
    about = read_about(checkpoints, steps)
    config = load_config(about)
    num_seeds = about["config"].get("seeds", 1)
    if not 0 <= run < num_seeds:
        raise ValueError(f"run must be from 0 to {num_seeds - 1}, got {run}.")
    # The networks are those of training, whose environments may show more than pixels.
    env, params = make_env(config, **WITHOUT_DISTRACTORS)
    algorithm = ALGORITHMS[about["algorithm"]](config, VectorPixelEnv(env, config.num_envs))
    runs = Runs(algorithm, num_seeds)
    template = runs.template(params).networks
    networks = runs.split(read_networks(checkpoints, template, about["steps"]))[run]
    clips = about.get("clips")
    return Trained(
        algorithm,
        networks,
        about["steps"],
        about["config"].get("seed", 0) + run,
        None if clips is None else tuple(clips),
    )


def with_clips(agent: Trained, clips: str | None) -> tuple[TrainConfig, tuple[str, ...] | None]:
    """Return the settings of an agent, and digests of the clips that its training played.

    Those are None where none are stored and the clips are no longer where they were.

    Args:
        agent: who plays.
        clips: a folder or ``"procedural"`` for the settings; None keeps that of the training.

    Raises:
        ValueError: clips are given, but no distractor of the run plays any.
    """
    config, shown = agent.algorithm.config, agent.clips
    if clips is None:
        return config, shown
    if "test" not in splits_of(config):
        raise ValueError(
            f"--clips {clips} is given, but no distractor of the run plays clips; it had "
            f"{', '.join(map(str, as_tuple(config.env.distractors))) or 'none'}."
        )
    if shown is None:
        with suppress(FileNotFoundError):
            shown = tuple(clip_digests(make_env(config)[1].clips))
    return config.replace(clips=clips), shown


def load_config(about: Mapping[str, Any]) -> TrainConfig:
    """Return the settings that are stored with a checkpoint, or raise if they are unknown here."""
    if about["algorithm"] not in ALGORITHMS:
        raise CheckpointError(
            f"the checkpoint is of {about['algorithm']!r}, which is none of "
            f"{', '.join(ALGORITHMS)}; read one of your own with "
            "pixelbrax_jax.agents.runner.checkpoint.read_networks."
        )
    kind = ALGORITHMS[about["algorithm"]].config_class
    former = former_settings(kind)
    if unknown := unknown_settings(about, former):
        raise CheckpointError(unknown.strip())
    stored = former | about["config"]
    return kind().replace(**{name: stored[name] for name in former if name not in OF_RUNS})


def save_policy(algorithm: Algorithm, networks: Networks, path: str | Path) -> Path:
    """Write a policy's mean action as a compiled function of JAX's export format.

    The file holds program and parameters, runs on CPU, CUDA and TPU for any number of
    observations, and needs nothing but JAX: ``jax.export.deserialize(bytes).call(pixels)``.

    Args:
        algorithm: whose ``act`` is stored.
        networks: its parameters.
        path: of the file, which is returned.
    """
    spec = algorithm.envs.env.obs_spec
    spec = spec["pixels"] if isinstance(spec, dict) else spec
    acting = {name: networks[name] for name in algorithm.acting}
    (batch,) = jax.export.symbolic_shape("batch")
    exported = jax.export.export(
        jax.jit(lambda pixels: algorithm.act(acting, pixels)), platforms=PLATFORMS
    )(jax.ShapeDtypeStruct((batch, *spec.shape), jnp.uint8))
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Written aside and renamed: a file of this name is always whole.
    part = path.with_name(path.name + ".part")
    try:
        part.write_bytes(exported.serialize())
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        raise
    return path
