"""``pixelbrax play``: a task on the screen, or in an animated image."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from itertools import islice
from typing import Any

import jax
import numpy as np

from pixelbrax_gym.gymnasium.env import GymnasiumEnv
from pixelbrax_gym.gymnasium.window import Window
from pixelbrax_jax.extras import install_extra
from pixelbrax_jax.policy import load_policy
from pixelbrax_jax.validation import check_positive_int
from pixelbrax_jax.video import NO_WRITER, write_frames

ENV_OPTIONS = ("backend", "camera", "look", "shadows", "distractors", "clips", "split")
"""Options of an environment that the command takes; one that is not given stays as it is."""

Act = Callable[[np.ndarray], np.ndarray]


def play(options: argparse.Namespace) -> int:
    """Run the command; see ``pixelbrax play --help``.

    Returns:
        The exit status: 130 after Ctrl-C, which leaves a whole file.
    """
    try:
        check_positive_int("size", options.size)
        check_positive_int("num_frames", options.num_frames)
        env, act = _make(options)
        lacking = "" if options.gif else _no_window()
        # Of a task module:name, not all systems have files so called.
        name = options.task.rpartition(":")[2]
        written = options.gif or (f"{name}.gif" if lacking else None)
        if written and None in map(find_spec, ("imageio_ffmpeg", "PIL")):
            raise ImportError(f"{lacking}; {NO_WRITER}" if lacking else NO_WRITER)
        if lacking:
            sys.stderr.write(f"pixelbrax play: {lacking}; writing {written} in its place\n")
        sys.stderr.write("pixelbrax play: compiling, which may take two minutes\n")
        shown = images(env, act, options.seed, options.size if options.observation else None)
        if written is None:
            _show(shown, env.metadata["render_fps"], f"PixelBrax {options.task}")
        else:
            frames = islice(shown, options.num_frames)
            path = write_frames(written, frames, env.metadata["render_fps"])
            sys.stdout.write(f"{path.resolve()}\n")
    except KeyboardInterrupt:
        return 130
    except (ValueError, TypeError, OSError, ImportError) as error:
        sys.stderr.write(f"pixelbrax play: {error}\n")
        return 1
    return 0


def images(env: GymnasiumEnv, act: Act, seed: int, observed: int | None) -> Iterator[np.ndarray]:
    """Play for ever, episode after episode.

    Args:
        env: with ``render_mode="rgb_array"``.
        act: gives an (A,) float32 action for an (H, W, 3 K) uint8 observation.
        seed: of the first episode.
        observed: None yields what ``render`` draws; a number the newest frame of the observation,
            enlarged by a whole factor to about so many pixels.

    Yields:
        (H, W, 3) uint8 images.
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


def _make(options: argparse.Namespace) -> tuple[GymnasiumEnv, Act]:
    given = {name: getattr(options, name) for name in ENV_OPTIONS}
    given = {name: value for name, value in given.items() if value is not None}
    policy = None
    if options.policy == "pretrained":
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


def _show(shown: Iterator[np.ndarray], fps: int, title: str) -> None:
    window = Window(title, fps)
    try:
        for image in shown:
            window.show(image)
            if window.closed:
                return
    finally:
        window.close()


def _no_window() -> str:
    """Why no window can be opened; empty if one can."""
    if find_spec("pygame") is None:
        return f"no window, for pygame is missing; try: {install_extra('human')}"
    known = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    if sys.platform == "linux" and not any(map(os.environ.get, known)):
        return "no window, for there is no display"
    return ""
