"""Settings of every algorithm: environment, networks and optimiser."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, ClassVar, Self, get_args, get_type_hints

import numpy as np

from pixelbrax_jax.agents.networks.encoders import ENCODERS, SMALLEST
from pixelbrax_jax.config import ENV_OPTIONS, EnvConfig
from pixelbrax_jax.distractors.presets import as_tuple
from pixelbrax_jax.envs.making import make
from pixelbrax_jax.envs.pixel_env import PixelEnv
from pixelbrax_jax.observations import IMAGES
from pixelbrax_jax.ranges import Ranges, check_ranges
from pixelbrax_jax.types import EnvParams
from pixelbrax_jax.validation import (
    check_bool,
    check_choice,
    check_count,
    check_finite,
    check_fraction,
    check_not_negative,
    check_options,
    check_positive,
    check_positive_int,
)

PositiveInt = Annotated[int, check_positive_int]
Count = Annotated[int, check_count]
Fraction = Annotated[float, check_fraction]
Finite = Annotated[float, check_finite]
Positive = Annotated[float, check_positive]
NotNegative = Annotated[float, check_not_negative]


def check_annotated(settings: Any) -> None:
    """Check bools and fields whose types carry a check, and store them as Python's own types."""
    for name, kind in get_type_hints(type(settings), include_extras=True).items():
        value, checks = getattr(settings, name), getattr(kind, "__metadata__", ())
        if value is None and type(None) in get_args(getattr(kind, "__origin__", kind)):
            continue
        for check in (check_bool,) if kind is bool else checks:
            object.__setattr__(settings, name, check(name, value))


@dataclass(frozen=True)
class TrainConfig:
    """Settings of every algorithm; one out of range is a ValueError, a wrong type a TypeError."""

    env: EnvConfig = EnvConfig()  # noqa: RUF009 (it is frozen)
    """Sets the environment's options; cameras, look, clips and distractors are names."""

    test_dynamics: Ranges = ""
    """Option ``dynamics`` of the split ``test`` in evaluations; without it they have that of the
    training."""

    memory_settings: ClassVar[tuple[str, ...]] = ("num_envs",)
    """Settings that reduce memory when they are lowered."""

    total_steps: PositiveInt = 25_000_000
    """Control steps of the run over all environments, rounded up to whole iterations."""
    num_envs: PositiveInt = 256
    """Number of environments N that run in parallel."""

    encoder: str = "impala"
    """Network that encodes pixels: ``impala``, ``nature``, ``drq``, ``small``, ``patch`` or
    ``patch2``."""
    state_critic: bool = False
    """Trains a separate critic on the simulator's state instead of pixels."""

    gamma: Fraction = 0.99
    """Discount of rewards per action."""
    learning_rate: Positive = 3e-4
    """Adam's step size."""
    anneal: bool = False
    """Decreases the step size linearly to 0."""
    adam_eps: Positive = 1e-5
    """Adam's epsilon."""
    max_grad_norm: NotNegative = 0.5
    """Clips the gradient of each network to this global norm; 0 disables clipping."""
    memory_budget_gb: Annotated[float | None, check_positive] = None
    """Memory limit of stored frames and state in GB (10^9 bytes); None uses the device's memory."""

    def __post_init__(self) -> None:
        _check_env(self.env)
        check_annotated(self)
        object.__setattr__(self, "test_dynamics", check_ranges("test_dynamics", self.test_dynamics))
        check_choice("encoder", self.encoder, ENCODERS)
        smallest = SMALLEST[self.encoder]
        if min(self.env.height, self.env.width) < smallest:
            raise ValueError(
                f"encoder {self.encoder!r} needs images of at least {smallest} x {smallest} "
                f"pixels, got {self.env.height} x {self.env.width}; raise height and width, or "
                "choose another encoder."
            )

    @property
    def steps_per_iteration(self) -> int:
        """Control steps of one iteration over all environments."""
        raise NotImplementedError(f"{type(self).__name__} lacks steps_per_iteration.")

    @property
    def frame_channels(self) -> int:
        """Channels of one frame of an observation."""
        return IMAGES[self.env.obs_mode].channels * self.env.num_cameras

    @property
    def frame_bytes(self) -> int:
        """Bytes of one frame of an observation."""
        size = np.dtype(IMAGES[self.env.obs_mode].dtype).itemsize
        return self.env.height * self.env.width * self.frame_channels * size

    @property
    def num_iterations(self) -> int:
        """Number of iterations of the run."""
        return -(-self.total_steps // self.steps_per_iteration)

    @property
    def bytes_per_iteration(self) -> int:
        """Bytes of the frames that an iteration stores besides the state."""
        return 0

    @property
    def steps_to_fill(self) -> int:
        """Steps of the agent that fill an empty replay before learning begins."""
        return 0

    def to_fit(self, excess: float) -> str:
        """Suggest how to reduce a run's memory by ``excess`` bytes."""
        del excess
        return (
            f"Lower {', '.join(self.memory_settings)} or the image size, or raise memory_budget_gb."
        )

    def replace(self, **settings: Any) -> Self:
        """Return a copy with changed settings, also of the environment, such as ``height=64``.

        Raises:
            TypeError: a name is unknown.
            ValueError: a setting is out of range.
        """
        own = [field.name for field in fields(self)]
        check_options(settings, [*own, *ENV_OPTIONS])
        of_env = {name: settings.pop(name) for name in ENV_OPTIONS if name in settings}
        if of_env:
            settings["env"] = replace(settings.get("env", self.env), **of_env)
        return replace(self, **settings)


def _check_env(env: EnvConfig) -> None:
    """Reject options without pixels, and options that JSON cannot store."""
    if not isinstance(env, EnvConfig):
        raise TypeError(f"env must be an EnvConfig, got {env!r}.")
    cameras = (("camera", camera) for camera in env.cameras)
    clips = "" if env.clips is None else env.clips
    for name, value in (*cameras, ("look", env.look), ("clips", clips)):
        if not isinstance(value, str):
            raise TypeError(f"{name} of training settings must be a name, got {value!r}.")
    if not all(isinstance(item, str) for item in as_tuple(env.distractors)):
        raise TypeError(f"distractors of training settings must be names, got {env.distractors!r}.")
    if env.camera_sizes:
        raise ValueError(
            "camera_sizes cannot be trained on, because an agent's cameras are channels of one "
            "image: leave them out; height and width are for all cameras."
        )
    if env.obs_mode not in ("pixels", "depth"):
        raise ValueError(
            f"obs_mode of training settings must be 'pixels' or 'depth', got {env.obs_mode!r}; "
            "state_critic=True shows the simulator's state to a critic."
        )


def make_env(config: TrainConfig, **changes: Any) -> tuple[PixelEnv, EnvParams]:
    """Make the environment of the settings; ``changes`` override its ``EnvConfig``."""
    obs_mode = config.env.obs_mode + ("+state" if config.state_critic else "")
    return make(config.env, **({"obs_mode": obs_mode} | changes))


def describe(config: TrainConfig) -> dict[str, Any]:
    """Return all settings by name as JSON values, with the environment's options."""
    names = [field.name for field in fields(config) if field.name != "env"]
    values = {name: getattr(config.env, name) for name in ENV_OPTIONS}
    values |= {name: getattr(config, name) for name in names}
    return {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()}


def check_divides(whole: str, size: int, part: str, count: int) -> None:
    """Raise a ValueError that lists the divisors of ``size`` unless ``count`` divides it."""
    if size % count:
        allowed = ", ".join(str(n) for n in range(1, size + 1) if size % n == 0)
        raise ValueError(f"{part}={count} must divide {whole}={size}; it may be {allowed}.")
