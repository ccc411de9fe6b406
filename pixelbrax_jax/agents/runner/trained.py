"""A trained agent, from the folder of its run."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import jax

from pixelbrax_jax.agents.algorithms.registry import ALGORITHMS
from pixelbrax_jax.agents.core.algorithm import Algorithm
from pixelbrax_jax.agents.core.config import TrainConfig, make_env
from pixelbrax_jax.agents.core.optimizer import Networks
from pixelbrax_jax.agents.runner.checkpoint import (
    CheckpointError,
    best_steps,
    read_about,
    read_networks,
)
from pixelbrax_jax.agents.runner.evaluate import WITHOUT_DISTRACTORS
from pixelbrax_jax.agents.runner.seeds import Runs
from pixelbrax_jax.envs.vector import VectorPixelEnv


@dataclass(frozen=True)
class Trained:
    """One run's networks at one checkpoint.

    Attributes:
        algorithm: with the run's settings; its ``act`` plays.
        networks: for ``act``, for an ``Evaluator`` and for ``save_policy``.
        steps: control steps of the checkpoint.
    """

    algorithm: Algorithm
    networks: Networks
    steps: int


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
        CheckpointError: there is no such checkpoint, or it is of an algorithm that is not known
            here.
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
    template = jax.eval_shape(runs.init, 0, params).networks
    networks = runs.split(read_networks(checkpoints, template, about["steps"]))[run]
    return Trained(algorithm, networks, about["steps"])


def load_config(about: dict[str, Any]) -> TrainConfig:
    """Return the settings that are stored with a checkpoint.

    Raises:
        CheckpointError: it is of an algorithm that is not known here.
    """
    if about["algorithm"] not in ALGORITHMS:
        raise CheckpointError(
            f"the checkpoint is of {about['algorithm']!r}, which is none of "
            f"{', '.join(ALGORITHMS)}; read one of your own with "
            "pixelbrax_jax.agents.runner.checkpoint.read_networks."
        )
    kind = ALGORITHMS[about["algorithm"]].config_class
    names = {field.name for field in fields(kind)}
    values: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in about["config"].items()
        if name in names
    }
    return replace(kind(), **values)
