"""Procedural clips, the same on every machine: IEEE 754 defines all operations to the bit."""

from __future__ import annotations

import numpy as np

FRAMES = 64
"""Frames of every clip, which loops without a jump."""

_FAMILIES = {
    "train": ("noise", "gratings"),
    "test": ("noise", "gratings"),
    "ood": ("blobs", "tiles"),
}
_FIRST_SEED = {"train": 1_000, "test": 2_000, "ood": 3_000}
_CLIPS = {"train": 16, "test": 8, "ood": 8}

SPLITS = tuple(_FAMILIES)


def names(split: str) -> list[str]:
    """Return the names of a split's clips: family and seed."""
    families, first = _FAMILIES[split], _FIRST_SEED[split]
    return [f"{families[i % len(families)]}-{first + i}" for i in range(_CLIPS[split])]


def clip(name: str, height: int, width: int) -> np.ndarray:
    """Return the clip of one of ``names``, (FRAMES, height, width, 3) uint8."""
    family, seed = name.split("-")
    random = _SplitMix64(int(seed))
    # In units of the image's smaller side.
    unit = 1.0 / min(height, width)
    y = (np.arange(height) + 0.5)[:, None] * unit
    x = (np.arange(width) + 0.5)[None, :] * unit
    palette = random.uniform((3, 3))
    planes = _PAINTERS[family](x, y, random)
    return np.stack([_colored(plane, palette) for plane in planes])


class _SplitMix64:
    """SplitMix64 (Steele, Lea and Flood, OOPSLA 2014); NumPy may change its generators' streams."""

    def __init__(self, seed: int) -> None:
        self._state = np.uint64(seed)

    def uniform(self, shape: tuple[int, ...]) -> np.ndarray:
        """Return float64 in [0, 1)."""
        count = int(np.prod(shape, dtype=np.int64))
        with np.errstate(over="ignore"):
            steps = np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
            z = self._state + steps
            self._state = z[-1] if count else self._state
            z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            z = z ^ (z >> np.uint64(31))
        return ((z >> np.uint64(11)) * 2.0**-53).reshape(shape)

    def integer(self, low: int, high: int) -> int:
        """Return an integer in [low, high]."""
        return low + int(self.uniform((1,))[0] * (high - low + 1))


def _colored(plane: np.ndarray, palette: np.ndarray) -> np.ndarray:
    """Map values in [0, 1] to colors between the three of a palette."""
    value = np.minimum(np.maximum(plane, 0.0), 1.0)[..., None] * 2.0
    low = palette[0] + (palette[1] - palette[0]) * np.minimum(value, 1.0)
    colors = low + (palette[2] - palette[1]) * np.maximum(value - 1.0, 0.0)
    return np.floor(colors * 255.0 + 0.5).astype(np.uint8)


def _smooth(t: np.ndarray) -> np.ndarray:
    return t * t * (3.0 - 2.0 * t)


def _wave(phase: np.ndarray) -> np.ndarray:
    fraction = phase - np.floor(phase)
    return _smooth(np.abs(2.0 * fraction - 1.0))


def _noise(x: np.ndarray, y: np.ndarray, random: _SplitMix64) -> list[np.ndarray]:
    """Return moving value noise in three octaves, on lattices that repeat."""
    lattices = [random.uniform((size, size)) for size in (8, 16, 32)]
    # Whole periods per clip, so that it loops.
    drift = [(random.integer(-1, 1), random.integer(-1, 1)) for _ in lattices]
    drift[0] = (1, drift[0][1])
    planes = []
    for frame in range(FRAMES):
        fraction = frame / FRAMES
        plane = np.zeros(np.broadcast_shapes(x.shape, y.shape))
        for octave, (lattice, (dx, dy)) in enumerate(zip(lattices, drift, strict=True)):
            size = lattice.shape[0]
            cells = 4.0 * 2.0**octave
            u, v = x * cells + dx * fraction * size, y * cells + dy * fraction * size
            plane = plane + _value_noise(lattice, u, v) * 0.5**octave
        planes.append((plane / 1.75 - 0.5) * 1.8 + 0.5)
    return planes


def _value_noise(lattice: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    size = lattice.shape[0]
    u, v = np.broadcast_arrays(u, v)
    left, top = np.floor(u), np.floor(v)
    fu, fv = _smooth(u - left), _smooth(v - top)
    i, j = left.astype(np.int64) % size, top.astype(np.int64) % size
    i1, j1 = (i + 1) % size, (j + 1) % size
    upper = lattice[j, i] + (lattice[j, i1] - lattice[j, i]) * fu
    lower = lattice[j1, i] + (lattice[j1, i1] - lattice[j1, i]) * fu
    return upper + (lower - upper) * fv


def _gratings(x: np.ndarray, y: np.ndarray, random: _SplitMix64) -> list[np.ndarray]:
    waves = []
    for _ in range(2):
        along = (random.integer(-4, 4), random.integer(1, 4))
        length = np.sqrt(float(along[0] ** 2 + along[1] ** 2))
        pitch = 2.0 + 6.0 * float(random.uniform((1,))[0])
        speed = random.integer(1, 3) * (1 if random.integer(0, 1) else -1)
        waves.append((along[0] / length * pitch, along[1] / length * pitch, speed))
    (a, b, fast), (c, d, slow) = waves
    return [
        0.5 * _wave(x * a + y * b + fast * frame / FRAMES)
        + 0.5 * _wave(x * c + y * d + slow * frame / FRAMES)
        for frame in range(FRAMES)
    ]


def _blobs(x: np.ndarray, y: np.ndarray, random: _SplitMix64) -> list[np.ndarray]:
    number = 7
    centers, radii = random.uniform((number, 2)), 0.08 + 0.17 * random.uniform((number,))
    reach, phases = 0.3 * random.uniform((number, 2)), random.uniform((number, 2))
    heights = 0.4 + 0.6 * random.uniform((number,))
    planes = []
    for frame in range(FRAMES):
        plane = np.zeros(np.broadcast_shapes(x.shape, y.shape))
        for k in range(number):
            shift = reach[k] * (_wave(phases[k] + frame / FRAMES) - 0.5)
            dx, dy = x - centers[k, 0] - shift[0], y - centers[k, 1] - shift[1]
            square = dx * dx + dy * dy
            fall = np.maximum(1.0 - square / (radii[k] * radii[k]), 0.0)
            plane = np.maximum(plane, heights[k] * fall * fall)
        planes.append(plane)
    return planes


def _tiles(x: np.ndarray, y: np.ndarray, random: _SplitMix64) -> list[np.ndarray]:
    """Return a scrolling page of glyphs with 5 x 5 dots."""
    size = 48
    dots = (random.uniform((size, size)) < 0.45).astype(np.float64)
    gap = np.arange(size) % 6 == 5
    dots[gap, :] = 0.0
    dots[:, gap] = 0.0
    across, down = random.integer(-1, 1), random.integer(0, 1) * 2 - 1
    planes = []
    for frame in range(FRAMES):
        i = np.floor(x * 24.0 + across * frame * size / FRAMES).astype(np.int64) % size
        j = np.floor(y * 24.0 + down * frame * size / FRAMES).astype(np.int64) % size
        planes.append(0.15 + 0.7 * dots[j, i])
    return planes


_PAINTERS = {"noise": _noise, "gratings": _gratings, "blobs": _blobs, "tiles": _tiles}
