"""Settings of a run: its folder, seeds, logs, evaluations and checkpoints."""

from __future__ import annotations

from dataclasses import dataclass

from pixelbrax_jax.agents.config import check_count, check_positive
from pixelbrax_jax.validation import check_choice, check_positive_int

RESUME = ("never", "latest")


@dataclass(frozen=True)
class RunConfig:
    """What is done around the training; nothing but the seeds changes a bit of it."""

    output_dir: str = "runs/train"
    """Folder of logs, checkpoints and the policy."""
    seed: int = 0
    """Seed of the run."""
    seeds: int = 1
    """Runs in one program, of the seeds ``seed``, ``seed`` + 1, ..."""
    resume: str = "never"
    """``latest`` goes on from the latest checkpoint in the folder, if there is one."""
    log_training_metrics: bool = True
    """Whether metrics of the training itself are logged."""
    log_every: int = 1
    """Iterations that one record sums up."""
    num_evals: int = 0
    """Evaluations, evenly over the run, the last at its end; 0 never makes such environments."""
    eval_episodes: int = 32
    """Episodes of an evaluation, for each split."""
    checkpoint_every: int = 0
    """Control steps between checkpoints, besides those by the clock, at evaluations and at the end;
    0 writes no more than those."""
    checkpoint_minutes: float = 10.0
    """Minutes without a checkpoint after which one is written; 0 goes by no clock."""
    keep_checkpoints: int = 3
    """Latest checkpoints that are kept, besides the best."""
    wandb_project: str | None = None
    """Project of Weights & Biases; none writes nothing there."""
    progress: bool = True
    """Whether a progress bar is shown."""

    def __post_init__(self) -> None:
        """Check the settings.

        Raises:
            ValueError: a setting is out of range; the message says what is allowed.
        """
        check_choice("resume", self.resume, RESUME)
        for name in ("seeds", "log_every", "eval_episodes", "keep_checkpoints"):
            check_positive_int(name, getattr(self, name))
        for name in ("seed", "num_evals", "checkpoint_every"):
            check_count(name, getattr(self, name))
        check_positive("checkpoint_minutes", self.checkpoint_minutes, or_zero=True)
        if self.seed + self.seeds > 2**32:
            raise ValueError(
                f"seeds must be below 2**32, got seed={self.seed} and seeds={self.seeds}."
            )
