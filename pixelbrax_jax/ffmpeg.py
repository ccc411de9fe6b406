"""Encoding and decoding of videos with an FFmpeg process."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np

_VARIABLE = "IMAGEIO_FFMPEG_EXE"


def find_ffmpeg() -> str:
    """Return the path of the FFmpeg program, or raise ImportError or OSError with the fix."""
    import imageio_ffmpeg

    try:
        program: str = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise FileNotFoundError(
            f"imageio-ffmpeg has no FFmpeg for this machine; install one and set {_VARIABLE} to it."
        ) from error
    # imageio-ffmpeg tries all programs but that of the variable.
    if shutil.which(program) is None:
        raise FileNotFoundError(
            f"the environment variable {_VARIABLE} is {program!r}, which is not a program; unset "
            "it to use the FFmpeg of imageio-ffmpeg."
        )
    return program


def check_ffmpeg() -> None:
    """Raise the errors of ``find_ffmpeg``, or OSError with the reason if FFmpeg does not start."""
    command = [find_ffmpeg(), "-version"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        raise OSError(f"{command[0]} does not start: {reason(result.stderr) or result.returncode}.")


@contextlib.contextmanager
def encoder(path: Path, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Return a function that writes a frame to an MP4 file in H.264, 4:2:0, as all players support.

    An odd side gets its last row or column twice. OSError has the reason of a failure.
    """
    # Each PPM has its own size. Without libx264 FFmpeg would choose a codec few players support.
    frames = ["-f", "image2pipe", "-c:v", "ppm", "-framerate", str(fps), "-i", "-"]
    h264 = ["-f", "mp4", "-c:v", "libx264", "-pix_fmt", "yuv420p", str(path.absolute())]
    command = [find_ffmpeg(), "-y", "-v", "error", *frames, *h264]
    # The log is a file, because FFmpeg stops once a pipe that nobody reads is full.
    with tempfile.TemporaryFile() as log:
        process = _start(command, stdin=subprocess.PIPE, stderr=log)
        assert process.stdin is not None
        pipe = process.stdin

        def append(frame: np.ndarray) -> None:
            odd = [(0, side % 2) for side in frame.shape[:2]]
            frame = np.pad(frame, (*odd, (0, 0)), mode="edge")
            pipe.write(b"P6\n%d %d\n255\n" % (frame.shape[1], frame.shape[0]))
            pipe.write(frame.tobytes())

        try:
            yield append
        finally:
            with contextlib.suppress(OSError):
                pipe.close()
            status = process.wait()
            if status:
                why = reason(_read(log)) or f"FFmpeg's exit status is {status}"
                if status < 0:
                    why = f"FFmpeg was ended by {signal.Signals(-status).name}"
                path.unlink(missing_ok=True)  # incomplete; no player plays it
                raise OSError(f"{path} was not written: {why}.")


def decode(path: Path, keep: Callable[[np.ndarray], None]) -> tuple[int, str]:
    """Call ``keep`` with each frame of a video, at a constant rate, rotated as a player does.

    Frames are (H, W, 3) uint8. Returns their number, and FFmpeg's log.
    """
    found = 0
    # Each PPM has its own size; a video may change its size.
    images = ["-f", "image2pipe", "-c:v", "ppm", "-pix_fmt", "rgb24", "-"]
    # An absolute path, because FFmpeg takes a name with a colon for a protocol.
    file = ["-nostdin", "-nostats", "-loglevel", "level+info", "-i", str(path.absolute())]
    with (
        tempfile.TemporaryFile() as log,
        # At an error the pipe is closed, which ends FFmpeg.
        _start([find_ffmpeg(), *file, *images], stdout=subprocess.PIPE, stderr=log) as process,
    ):
        assert process.stdout is not None
        while (image := _read_ppm(process.stdout)) is not None:
            keep(image)
            found += 1
        process.wait()
        return found, _read(log)


def complaint(log: str) -> str:
    """Return the first error of the log of ``decode`` in one line; empty if none."""
    if "Stream #0:" in _source(log) and "Video: " not in _source(log):
        return "it has only sound"
    return reason(log) if "[error]" in log or "[fatal]" in log else ""


def declared_frames(path: Path, log: str) -> tuple[int, bool]:
    """Return the approximate number of frames a video declares, 0 if none, by ``decode``'s log.

    The second result is whether it follows from the length of a file whose sound may be longer.
    """
    source, count = _source(log), _frames_of_avi(path)
    duration = re.search(r"Duration: (\d+):(\d+):([\d.]+)", source)
    rate = re.search(r"Video: .* ([\d.]+) fps", source)
    has_sound = source.count("Stream #0:") > 1
    if not duration or not rate or (has_sound and count):
        return count, False
    hours, minutes, seconds = map(float, duration.groups())
    length = 3600 * hours + 60 * minutes + seconds
    return max(count, round(length * float(rate[1]))), has_sound


def reason(log: str) -> str:
    """Return the first error of FFmpeg's log, without its prefixes; empty if none."""
    lines = [line for line in log.splitlines() if line.strip()]
    wrong = [line for line in lines if "[error]" in line or "[fatal]" in line] or lines
    # "[mov,mp4 @ 0x55] [error] moov atom not found"
    said = [re.sub(r"^(\[[^]]*\]\s*)+", "", line).strip().rstrip(".") for line in wrong]
    return said[0] if said else ""


def _source(log: str) -> str:
    return log.partition("Output #0")[0]


def _start(command: list[str], **pipes: Any) -> subprocess.Popen[bytes]:
    # In a separate process group, so that Ctrl-C does not end it before its file is complete.
    return subprocess.Popen(command, process_group=0 if os.name == "posix" else None, **pipes)


def _read_ppm(pipe: IO[bytes]) -> np.ndarray | None:
    if pipe.readline() != b"P6\n":
        return None
    width, height = map(int, pipe.readline().split())
    pipe.readline()  # 255
    pixels = pipe.read(width * height * 3)
    if len(pixels) < width * height * 3:
        return None
    return np.frombuffer(pixels, np.uint8).reshape(height, width, 3)


def _frames_of_avi(path: Path) -> int:
    """Return the frame count of an AVI's main header, else 0; FFmpeg derives it from the size."""
    with path.open("rb") as file:
        head = file.read(52)
    if head[:4] != b"RIFF" or head[24:28] != b"avih":
        return 0
    return int.from_bytes(head[48:52], "little")


def _read(log: IO[bytes]) -> str:
    log.seek(0)
    return log.read().decode("utf-8", "replace")
