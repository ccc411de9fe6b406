"""Encoding and decoding of videos with an FFmpeg process."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np

_VARIABLE = "IMAGEIO_FFMPEG_EXE"


def find_ffmpeg() -> str:
    """Return the path of the FFmpeg program.

    Raises:
        ImportError: imageio-ffmpeg, which includes it, is not installed.
        OSError: no FFmpeg exists for this machine, it cannot be started, or ``IMAGEIO_FFMPEG_EXE``
            is not a program; the message has the fix.
    """
    import imageio_ffmpeg

    try:
        program: str = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise FileNotFoundError(
            f"imageio-ffmpeg has no FFmpeg for this machine; install one and set {_VARIABLE} to it."
        ) from error
    if shutil.which(program) is None:
        if not os.environ.get(_VARIABLE):
            raise FileNotFoundError(
                f"the FFmpeg of imageio-ffmpeg, {program}, cannot be started; install "
                "imageio-ffmpeg again."
            )
        raise FileNotFoundError(
            f"the environment variable {_VARIABLE} is {program!r}, which is not a program; unset "
            "it to use the FFmpeg of imageio-ffmpeg."
        )
    return program


def check_ffmpeg() -> None:
    """Check that FFmpeg exists and starts.

    Raises:
        ImportError: imageio-ffmpeg, which includes it, is not installed.
        OSError: it does not start; with the reason.
    """
    command = [find_ffmpeg(), "-version"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        raise OSError(f"{command[0]} does not start: {reason(result.stderr) or result.returncode}.")


class Encoder:
    """Writes frames to an MP4 file in H.264, 4:2:0, which every player supports."""

    def __init__(self, path: Path, fps: float) -> None:
        """Find FFmpeg, with the errors of ``find_ffmpeg``; start no process."""
        self._program, self._path, self._fps = find_ffmpeg(), path, fps
        self._process: subprocess.Popen[bytes] | None = None
        self._log: IO[bytes] | None = None

    def append(self, frame: np.ndarray) -> None:
        """Write a frame; repeat the last row or column of an odd side.

        Raises:
            OSError: FFmpeg could not write it; with the reason.
        """
        height, width = (side % 2 for side in frame.shape[:2])
        if height or width:
            frame = np.pad(frame, ((0, height), (0, width), (0, 0)), mode="edge")
        frame = np.ascontiguousarray(frame)
        if self._process is None:
            self._start(*frame.shape[:2])
        assert self._process is not None
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(frame.data)
        except OSError as error:
            self.close()  # it says why
            raise OSError(f"{self._path} was not written: {error}.") from error

    def _start(self, height: int, width: int) -> None:
        taken = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
        # Named explicitly: an FFmpeg without it would choose a codec that few players support.
        h264 = ["-c:v", "libx264", "-pix_fmt", "yuv420p"]
        given = ["-f", "mp4", *h264, str(self._path.absolute())]
        # A file, because FFmpeg stops once a pipe that nobody reads is full.
        self._log = tempfile.TemporaryFile()  # noqa: SIM115
        self._process = _start(
            [self._program, "-y", "-v", "error", *taken, "-r", str(self._fps), "-i", "-", *given],
            stdin=subprocess.PIPE,
            stderr=self._log,
        )

    def close(self) -> None:
        """Finish the file.

        Raises:
            OSError: FFmpeg could not write it; with the reason.
        """
        process, log = self._process, self._log
        if process is None or log is None:
            return
        self._process = self._log = None
        assert process.stdin is not None
        with log:
            with contextlib.suppress(OSError):
                process.stdin.close()
            status = process.wait()
            if status:
                log.seek(0)
                why = reason(_text(log)) or f"FFmpeg's exit status is {status}"
                if status < 0:
                    why = f"FFmpeg was ended by {signal.Signals(-status).name}"
                self._path.unlink(missing_ok=True)  # a part of a file that no player plays
                raise OSError(f"{self._path} was not written: {why}.")


class Decoder:
    """Reads the frames of a video file at a constant rate, rotated as a player rotates them.

    Attributes:
        declared: after all frames, the approximate number of frames the file declares; None if it
            declares none.
        of_file: whether that number comes from the length of the whole file, whose sound may be
            longer than its video.
        complaint: FFmpeg's error in one line; empty if none.
    """

    def __init__(self, path: Path) -> None:
        """Find FFmpeg, with the errors of ``find_ffmpeg``; start no process."""
        self._program, self._path = find_ffmpeg(), path
        self.declared: int | None = None
        self.of_file = False
        self.complaint = ""

    def __iter__(self) -> Iterator[np.ndarray]:
        """Yield (H, W, 3) uint8 frames."""
        # Each PPM has its own size; a video may change its size.
        images = ["-f", "image2pipe", "-c:v", "ppm", "-pix_fmt", "rgb24", "-"]
        # An absolute path, because FFmpeg takes a name with a colon for a protocol.
        file = ["-nostdin", "-nostats", "-loglevel", "level+info", "-i", str(self._path.absolute())]
        with tempfile.TemporaryFile() as log:
            process = _start([self._program, *file, *images], stdout=subprocess.PIPE, stderr=log)
            assert process.stdout is not None
            try:
                with process.stdout as pipe:
                    while (image := _read_ppm(pipe)) is not None:
                        yield image
                    process.wait()
            finally:
                process.kill()  # of whoever stops early
                process.wait()
            log.seek(0)
            self._interpret(_text(log))

    def _interpret(self, log: str) -> None:
        source = log.partition("Output #0")[0]
        self.complaint = reason(log) if "[error]" in log or "[fatal]" in log else ""
        if "Stream #0:" in source and "Video: " not in source:
            self.complaint = "it has only sound"
        duration = re.search(r"Duration: (\d+):(\d+):([\d.]+)", source)
        rate = re.search(r"Video: .* ([\d.]+) fps", source)
        count = _frames_of_avi(self._path)
        alone = source.count("Stream #0:") <= 1
        if duration and rate and (alone or not count):
            hours, minutes, seconds = map(float, duration.groups())
            length = 3600 * hours + 60 * minutes + seconds
            count, self.of_file = max(count, round(length * float(rate[1]))), not alone
        self.declared = count or None


def reason(log: str) -> str:
    """Return the first error of FFmpeg's log, without its prefixes; empty if none."""
    lines = [line for line in log.splitlines() if line.strip()]
    wrong = [line for line in lines if "[error]" in line or "[fatal]" in line] or lines
    # "[mov,mp4 @ 0x55] [error] moov atom not found"
    said = [re.sub(r"^(\[[^]]*\]\s*)+", "", line).strip().rstrip(".") for line in wrong]
    return said[0] if said else ""


def _start(command: list[str], **pipes: Any) -> subprocess.Popen[bytes]:
    # In a separate process group, so that Ctrl-C does not end it before its file is complete.
    return subprocess.Popen(command, process_group=0 if os.name == "posix" else None, **pipes)


def _read_ppm(pipe: IO[bytes]) -> np.ndarray | None:
    """Return the next image of a pipe; None at its end."""
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


def _text(log: IO[bytes]) -> str:
    return log.read().decode("utf-8", "replace")
