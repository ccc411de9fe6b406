"""How much of the state a linear map reads off the pixels, clean and under a level.

    pip install -c constraints.txt ".[train,dataset,dmc]"   # in a clone
    pixelbrax dataset --pretrained dmc_walker_walk --suite dmcgb2 --level color-hard \
        --episodes 20 --output-dir pairs/walker
    python examples/linear_probe.py pairs/walker

A ridge regression from three consecutive clean frames to each entry of the state, fitted to four of
five episodes, is tested on the others. It prints the coefficient of determination R2 of each entry
for the clean images and for those of the level: 1 is a perfect reading, 0 the mean state.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import minari
import numpy as np

FRAMES = 3


def features(pixels: np.ndarray, cells: int) -> np.ndarray:
    """Map (T, H, W, C) uint8 pixels to (T - 2, D) means of cells of three consecutive frames."""
    _, height, width, _ = pixels.shape
    rows, columns = (np.arange(cells) * size // cells for size in (height, width))
    sums = np.add.reduceat(np.add.reduceat(pixels, rows, 1, np.float64), columns, 2)
    areas = np.outer(np.diff(rows, append=height), np.diff(columns, append=width))
    means = (sums / (255.0 * areas[..., None])).reshape(len(pixels), -1)
    ends = range(FRAMES, len(pixels) + 1)
    return np.stack([means[end - FRAMES : end].ravel() for end in ends])


def r_squared(predicted: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Return the (S,) coefficients of determination of (T, S) predictions."""
    spread = np.maximum(((state - state.mean(0)) ** 2).sum(0), 1e-12)
    return 1.0 - ((predicted - state) ** 2).sum(0) / spread


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Print the table; return the (S,) coefficients by view."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("dataset", help="folder of `pixelbrax dataset`")
    parser.add_argument("--cells", type=int, default=16, help="rows and columns of averaged pixels")
    parser.add_argument("--ridge", type=float, default=1.0, help="weight of the penalty")
    options = parser.parse_args(arguments)
    try:
        episodes = list(minari.MinariDataset(options.dataset).iterate_episodes())
    except ValueError as error:
        parser.error(str(error))
    episodes = [one for one in episodes if len(one.rewards) >= FRAMES - 1]
    if len(episodes) < 5:
        parser.error(f"{options.dataset} has {len(episodes)} episodes; record at least 5.")
    size = min(episodes[0].observations["pixels"].shape[1:3])
    if not 1 <= options.cells <= size:
        parser.error(f"--cells must lie in 1 to {size}, the size of images, got {options.cells}.")

    def stacked(part: list[Any], view: str) -> np.ndarray:
        return np.concatenate([features(one.observations[view], options.cells) for one in part])

    def states(part: list[Any]) -> np.ndarray:
        return np.concatenate([one.observations["state"][FRAMES - 1 :] for one in part])

    tests = episodes[::5]
    fitted = [one for number, one in enumerate(episodes) if number % 5]
    inputs, outputs = stacked(fitted, "pixels"), states(fitted)
    center, mean = inputs.mean(0), outputs.mean(0)
    inputs = inputs - center
    penalty = options.ridge * np.eye(inputs.shape[1])
    weights = np.linalg.solve(inputs.T @ inputs + penalty, inputs.T @ (outputs - mean))
    found = {
        view: r_squared((stacked(tests, view) - center) @ weights + mean, states(tests))
        for view in ("pixels", "pixels_level")
    }
    print("state   clean   level")
    for entry, (clean, level) in enumerate(zip(*found.values(), strict=True)):
        print(f"{entry:5}  {clean:6.2f}  {level:6.2f}")
    means = [float(np.mean(values)) for values in found.values()]
    print(f" mean  {means[0]:6.2f}  {means[1]:6.2f}")
    return found


if __name__ == "__main__":
    main()
