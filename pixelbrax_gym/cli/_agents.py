"""Options that select a trained agent."""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from pixelbrax_gym.cli import CommandError, UsageError
from pixelbrax_jax.extras import needs_extra

if TYPE_CHECKING:
    from pixelbrax_jax.agents.runner.trained import Trained


MAY_DIFFER = ("clips", "memory_budget_gb", "split")
"""Settings besides the seed in which the seeds of one agent may differ."""


@dataclass(frozen=True)
class AgentOptions:
    """Options that select a trained agent."""

    pretrained: str | None = None
    """Loads a policy of the package instead, by its task, such as halfcheetah."""
    steps: int | None = None
    """Loads the checkpoint of this many steps; default: the latest."""
    clips: str | None = None
    """Folder of the clips; default: the folder used in training. Split train needs the same
    clips."""
    best: bool = False
    """Loads the best checkpoint."""
    run_index: Annotated[int, arg(name="run")] = 0
    """Index of the run among those of --seeds, from 0."""


def load(options: AgentOptions, folder: str | None) -> Trained:
    """Load the agent of a run's folder, or the pretrained one, that the options select."""
    with needs_extra("train"):
        from pixelbrax_jax.agents.runner.checkpoint import CheckpointError
        from pixelbrax_jax.agents.runner.trained import load_pretrained, load_trained
    steps, best, run = options.steps, options.best, options.run_index
    if folder is not None and options.pretrained is None:
        try:
            return load_trained(folder, steps=steps, best=best, run=run)
        except CheckpointError as error:
            raise CommandError(str(error)) from error
    if folder is not None or options.pretrained is None:
        raise UsageError("give either the folder of a run or --pretrained with a name.")
    if steps is not None or best or run:
        raise UsageError("--steps, --best and --run need the folder of a run, not --pretrained.")
    return load_pretrained(options.pretrained)


def name_of(agent: Trained, folder: str) -> str:
    """Return a name that tells an agent from another one trained later in the same folder."""
    import jax
    import numpy as np

    found = sha256()
    for leaf in jax.tree.leaves(agent.networks):
        found.update(np.ascontiguousarray(leaf).data)
    digest = found.hexdigest()[:8]
    return f"{Path(folder)}, seed {agent.seed}, {agent.steps} steps, {digest}"
