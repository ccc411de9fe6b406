"""Show a task in a window or write it to a file."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from tyro.conf import Positional, arg

from pixelbrax_gym.cli import CommandError, parse, say
from pixelbrax_gym.resets import check_seed
from pixelbrax_jax.extras import install_extra
from pixelbrax_jax.validation import check_positive_int

if TYPE_CHECKING:
    from pixelbrax_gym.gymnasium.env import GymnasiumEnv

ENV_OPTIONS = ("backend", "camera", "look", "shadows", "distractors", "clips", "split", "dynamics")
"""Environment options of the command; those not given keep their defaults."""

Act = Callable[[np.ndarray], np.ndarray]
"""Maps an (H, W, 3 K) uint8 observation to an (A,) float32 action."""


@dataclass(frozen=True)
class Options:
    """Plays a task in a window, or writes an animated image if there is no display."""

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """Name of a task, such as ant ('pixelbrax tasks' lists all), or MODULE:NAME, which imports the
    module first."""
    policy: Literal["random", "zero", "pretrained"] = "random"
    """Policy that selects the actions; the package has pretrained policies for some tasks."""
    backend: str | None = None
    """Physics backend; default: the task's own."""
    camera: str | None = None
    """Name of a camera, such as top; an unknown name lists the task's cameras."""
    look: str | None = None
    """Light, sky and ground: default, original or dmc."""
    shadows: bool = False
    """Renders shadows."""
    distractors: tuple[str, ...] = ()
    """Distractors or presets of them, such as dcs-easy or paper-color."""
    clips: str | None = None
    """Clips of video distractors: a folder, or procedural."""
    split: str | None = None
    """Split of the clips: train, test or another split of the folder."""
    dynamics: str | None = None
    """Varied dynamics, such as friction=0.5:2,gravity=0.8."""
    observation: bool = False
    """Shows the pixels of the observation, enlarged."""
    size: int = 336
    """Height and width of the image in pixels."""
    seed: int = 0
    """Seed of the episodes and of random actions."""
    gif: str | None = None
    """Writes this .gif or .mp4 instead of opening a window."""
    num_frames: int = 200
    """Number of frames in the file."""


def run(arguments: Sequence[str]) -> int:
    """Run the command; after Ctrl-C the file is complete."""
    options = parse("play", Options, arguments)
    from pixelbrax_jax.video import NO_WRITER, check_suffix, write_frames

    check_positive_int("size", options.size)
    check_positive_int("num_frames", options.num_frames)
    check_seed(options.seed)
    if options.gif is not None:
        check_suffix(Path(options.gif))
    try:
        env, act = _make(options)
    except TypeError as error:
        raise CommandError(str(error)) from error
    lacking = "" if options.gif else _why_no_window()
    # Not all systems allow the colon of a task module:name in file names.
    name = options.task.rpartition(":")[2]
    written = options.gif or (f"{name}.gif" if lacking else None)
    if written and None in map(find_spec, ("imageio_ffmpeg", "PIL")):
        raise ImportError(f"{lacking}; {NO_WRITER}" if lacking else NO_WRITER)
    if lacking:
        say("play", f"{lacking}; writing {written} instead")
    say("play", "compiling, which may take two minutes")
    shown = images(env, act, options.seed, options.size if options.observation else None)
    fps = env.metadata["render_fps"]
    if written is None:
        from pixelbrax_gym.gymnasium.window import Window

        with closing(Window(f"PixelBrax {options.task}", fps)) as window:
            for image in shown:
                window.show(image)
                if window.closed:
                    break
    else:
        path = write_frames(written, islice(shown, options.num_frames), fps)
        sys.stdout.write(f"{path.resolve()}\n")
    return 0


def images(env: GymnasiumEnv, act: Act, seed: int, observed: int | None) -> Iterator[np.ndarray]:
    """Yield (H, W, 3) uint8 images of endless episodes, as ``render`` returns them.

    With ``observed``, yield the observation's newest frame, enlarged to about that many pixels.
    """
    obs, _ = env.reset(seed=seed)
    while True:
        if observed is None:
            yield np.asarray(env.render())
        else:
            factor = max(1, round(observed / max(obs.shape[:2])))
            yield obs[..., -3:].repeat(factor, axis=0).repeat(factor, axis=1)
        obs, _, terminated, truncated, _ = env.step(act(obs))
        if terminated or truncated:
            obs, _ = env.reset()


def _make(options: Options) -> tuple[GymnasiumEnv, Act]:
    import jax

    from pixelbrax_gym.gymnasium.env import GymnasiumEnv
    from pixelbrax_jax.policy import list_pretrained, load_policy

    given = {name: getattr(options, name) for name in ENV_OPTIONS}
    given = {name: value for name, value in given.items() if value not in (None, False, ())}
    policy = None
    if options.policy == "pretrained":
        if options.task not in (names := list_pretrained()):
            raise ValueError(
                f"task {options.task!r} has no pretrained policy; these tasks have one: "
                f"{', '.join(names)}."
            )
        policy = load_policy(options.task)
        given = (policy.env_options or {}) | given
    task: Any = given.pop("task", options.task)
    env = GymnasiumEnv(
        task,
        render_mode="rgb_array",
        render_height=options.size,
        render_width=options.size,
        **given,
    )
    if policy is not None:
        return env, lambda obs: jax.device_get(policy(jax.device_put(np.asarray(obs)[None])))[0]
    if options.policy == "zero":
        return env, lambda _: np.zeros(env.action_space.shape or (), np.float32)
    env.action_space.seed(options.seed)
    return env, lambda _: env.action_space.sample()


def _why_no_window() -> str:
    """Return why a window cannot be opened; empty if it can."""
    if find_spec("pygame") is None:
        return f"cannot open a window, pygame is not installed; try: {install_extra('human')}"
    known = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    if sys.platform == "linux" and not any(map(os.environ.get, known)):
        return "cannot open a window, there is no display"
    return ""
