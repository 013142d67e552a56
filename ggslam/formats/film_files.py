# SPDX-License-Identifier: Apache-2.0
"""Films, picture by picture: .mp4, .gif and .webp. A file appears when its film is whole.

H.264 needs an ffmpeg program, on the PATH or in the package imageio-ffmpeg. Without one, OpenCV writes VP9, which
browsers play, too.
"""

from __future__ import annotations

import functools
import importlib
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import cv2
import numpy as np

from ggslam.errors import ConfigError, MissingDependency, RunFolderError
from ggslam.system.atomic import atomic_write
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import open_untrusted

ENDINGS = (".mp4", ".gif", ".webp")
"""Of the files that films are written to."""


class FilmTuning(Tuning):
    """How films are compressed."""

    h264_crf = 18
    """Constant rate factor of x264; smaller is better and larger. 18 is hard to tell from the original."""
    webp_quality = 85
    """Of the pictures of a .webp, of 100."""
    gif_dither = 3
    """OpenCV's dither level of a .gif: 39 dB on photographs, against 7 and 17 with -1 and 0."""
    animation_bytes = 2_000_000_000
    """Largest size of the pictures of a .gif or .webp, which are held in memory."""


class FilmWriter(Protocol):
    """Takes the pictures of a film, uint8 [H, W, 3] RGB, all of one size."""

    note: str | None
    """What a user should know of the file; None: nothing."""

    def write(self, picture: np.ndarray) -> None: ...
    def finish(self) -> None: ...
    def abandon(self) -> None: ...


def film_ending(path: Path) -> str:
    """The ending of a film, in lower case; raises ConfigError for another than `ENDINGS`."""
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise ConfigError(f"`film`: expected a name that ends with {', '.join(ENDINGS)}, found {path.name!r}")
    return ending


@contextmanager
def write_film(path: str | Path, fps: float) -> Iterator[FilmWriter]:
    """Opens a film for writing; it takes its place when the block ends well, and else leaves nothing.

    Raises:
        ConfigError: another ending than `ENDINGS`.
        MissingDependency: OpenCV is too old for .gif and .webp.
        RunFolderError: the file cannot be written.
    """
    ending = film_ending(Path(path))
    with atomic_write(path) as temporary:
        writer = _writer_for(ending, temporary, fps)
        try:
            yield writer
            writer.finish()
            if not is_whole_film(temporary):  # the libraries keep a full disk to themselves
                failure = RunFolderError(f"cannot write {path}: the film was cut off; is the disk full?")
                failure.exit_code = 1
                raise failure
        except BaseException:
            writer.abandon()
            raise


def is_whole_film(path: Path) -> bool:
    """Whether a file of one of the `ENDINGS` has its end, going by the sizes that its parts state."""
    ending, size = film_ending(path), path.stat().st_size
    with open_untrusted(path, RunFolderError) as file:
        if ending == ".mp4":
            return _mp4_is_whole(file, size)
        if ending == ".webp":
            return int.from_bytes(file.read(8)[4:], "little") + 8 == size
        try:
            return _gif_end(file.read()) == size
        except (IndexError, ValueError):
            return False


def _mp4_is_whole(file: BinaryIO, size: int) -> bool:
    """Whether boxes, one of them with the index of the pictures, fill a file of so many bytes."""
    start, kinds = 0, set()
    while start < size:
        file.seek(start)
        head = file.read(16)
        kinds.add(head[4:8])
        long = head[:4] == b"\0\0\0\1"
        length = int.from_bytes(head[8:16] if long else head[:4], "big")
        if length < (16 if long else 8):
            return False
        start += length
    return start == size and b"moov" in kinds


def _gif_end(content: bytes) -> int:
    """Where its blocks end; raises IndexError if they do not."""
    start = 13 + _color_table(content[10])
    while (kind := content[start]) != 0x3B:
        if kind not in (0x21, 0x2C):
            raise ValueError("no block of a GIF")
        start += 2 if kind == 0x21 else 11 + _color_table(content[start + 9])
        while size := content[start]:
            start += size + 1
        start += 1
    return start + 1


def _color_table(flags: int) -> int:
    """Bytes of a table of colours."""
    return 3 << ((flags & 7) + 1) if flags & 0x80 else 0


def _writer_for(ending: str, path: Path, fps: float) -> FilmWriter:
    if ending != ".mp4":
        return _Animation(path, fps)
    program = find_ffmpeg()
    return _OpenCvFilm(path, fps) if program is None else _H264(path, fps, program)


@functools.cache
def find_ffmpeg() -> str | None:
    """An ffmpeg program that writes H.264: that of imageio-ffmpeg, or one on the PATH; None: there is none."""
    for find in (_bundled_ffmpeg, lambda: shutil.which("ffmpeg")):
        program = find()
        if program is not None and _writes_h264(program):
            return program
    return None


def _bundled_ffmpeg() -> str | None:
    try:
        return str(importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        return None


def _writes_h264(program: str) -> bool:
    try:
        found = subprocess.run([program, "-hide_banner", "-encoders"], capture_output=True, timeout=20, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return b"libx264" in found.stdout


class _H264:
    """H.264 by ffmpeg, which gets the pictures through a pipe."""

    def __init__(self, path: Path, fps: float, program: str) -> None:
        self._path, self._fps, self._program = path, fps, program
        self._process: subprocess.Popen[bytes] | None = None
        self.note: str | None = None

    def write(self, picture: np.ndarray) -> None:
        """Adds a picture."""
        picture = even(picture)
        if self._process is None:
            self._process = self._start(picture.shape[1], picture.shape[0])
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(picture.tobytes())
        except BrokenPipeError:
            self._fail()

    def _start(self, width: int, height: int) -> subprocess.Popen[bytes]:
        command = [
            self._program, "-hide_banner", "-loglevel", "error", "-y",
            "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{self._fps:g}", "-i", "-",
            "-vf", "scale=in_range=full:out_range=tv:out_color_matrix=bt709:flags=accurate_rnd",
            "-c:v", "libx264", "-crf", str(FilmTuning.h264_crf), "-pix_fmt", "yuv420p",
            "-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709", "-color_range", "tv",
            "-movflags", "+faststart", "-f", "mp4", str(self._path),
        ]  # fmt: skip
        # In a session of its own, it does not get the Ctrl-C that is meant for us.
        return subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
        )

    def finish(self) -> None:
        """Waits until the file is whole."""
        if self._process is None:
            raise ConfigError("a film needs a picture at least")
        assert self._process.stdin is not None
        try:
            self._process.stdin.close()
        except BrokenPipeError:
            self._fail()
        if self._process.wait() != 0:
            self._fail()
        self._close()

    def _fail(self) -> None:
        assert self._process is not None and self._process.stderr is not None
        said = self._process.stderr.read().decode(errors="replace").strip().splitlines()
        raise RunFolderError(f"ffmpeg could not write the film: {said[-1] if said else 'it gave no reason'}")

    def abandon(self) -> None:
        """Stops the program."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._close()

    def _close(self) -> None:
        assert self._process is not None and self._process.stderr is not None
        self._process.stderr.close()


class _OpenCvFilm:
    """VP9, or MPEG-4 where OpenCV lacks VP9."""

    def __init__(self, path: Path, fps: float) -> None:
        self._path, self._fps = path, fps
        self._writer: cv2.VideoWriter | None = None
        self.note: str | None = None

    def write(self, picture: np.ndarray) -> None:
        """Adds a picture."""
        picture = even(picture)
        if self._writer is None:
            self._writer = self._start(picture.shape[1], picture.shape[0])
        self._writer.write(np.ascontiguousarray(picture[..., ::-1]))

    def _start(self, width: int, height: int) -> cv2.VideoWriter:
        for code, name in (("vp09", "VP9"), ("mp4v", "MPEG-4 part 2, which browsers do not play,")):
            writer = cv2.VideoWriter(str(self._path), cv2.VideoWriter.fourcc(*code), self._fps, (width, height))
            if writer.isOpened():
                self.note = f"{name} by OpenCV; with `pip install imageio-ffmpeg`, H.264 is written, and faster"
                return writer
        raise MissingDependency("this OpenCV writes no .mp4: `pip install imageio-ffmpeg`, or choose .gif or .webp")

    def finish(self) -> None:
        """Writes the end of the file."""
        if self._writer is None:
            raise ConfigError("a film needs a picture at least")
        self._writer.release()
        if not self._path.stat().st_size:
            raise RunFolderError("OpenCV could not write the film; is the disk full?")

    def abandon(self) -> None:
        """Closes the file."""
        if self._writer is not None:
            self._writer.release()


class _Animation:
    """.gif and .webp, whose pictures are compressed together at the end."""

    def __init__(self, path: Path, fps: float) -> None:
        if not hasattr(cv2, "imwriteanimation"):
            raise MissingDependency(
                f"{path.suffix} needs OpenCV 4.11 or newer, found {cv2.__version__}: `pip install -U "
                "opencv-python-headless`, or choose .mp4"
            )
        self._path, self._fps = path, fps
        self._pictures: list[np.ndarray] = []
        self.note: str | None = None

    def write(self, picture: np.ndarray) -> None:
        """Adds a picture."""
        if (len(self._pictures) + 1) * picture.nbytes > FilmTuning.animation_bytes:
            raise ConfigError(
                f"the pictures of a {self._path.suffix} are held in memory, and these take more than "
                f"{FilmTuning.animation_bytes / 1e9:g} GB: choose .mp4, or a smaller `size`, `fps` or `seconds`"
            )
        self._pictures.append(np.ascontiguousarray(picture[..., ::-1]))

    def finish(self) -> None:
        """Compresses the pictures."""
        if not self._pictures:
            raise ConfigError("a film needs a picture at least")
        is_gif = self._path.suffix.lower() == ".gif"
        animation: Any = cv2.Animation()  # type: ignore[attr-defined,unused-ignore]  # not in older stubs
        animation.frames, animation.loop_count = self._pictures, 0
        animation.durations = durations(len(self._pictures), self._fps, 10 if is_gif else 1)
        options = (
            [cv2.IMWRITE_GIF_QUALITY, 2, cv2.IMWRITE_GIF_DITHER, FilmTuning.gif_dither, cv2.IMWRITE_GIF_COLORTABLE, 1]
            if is_gif else [cv2.IMWRITE_WEBP_QUALITY, FilmTuning.webp_quality]
        )  # fmt: skip
        write: Callable[..., bool] = cv2.imwriteanimation
        if not write(str(self._path), animation, options):
            raise RunFolderError("OpenCV could not write the film; is the disk full?")

    def abandon(self) -> None:
        """Forgets the pictures."""
        self._pictures.clear()


def durations(count: int, fps: float, unit_ms: int) -> list[int]:
    """Milliseconds that each picture of an animation is shown: whole units, whose sum stays within half a unit of the
    true time. Viewers slow down pictures shorter than 20 ms."""
    ends = np.round(np.arange(count + 1) * 1000 / fps / unit_ms).astype(int) * unit_ms
    return [int(step) for step in np.diff(ends)]


def even(picture: np.ndarray) -> np.ndarray:
    """A picture with an even number of rows and columns, which 4:2:0 needs; the last ones are repeated."""
    height, width = picture.shape[:2]
    if height % 2 or width % 2:
        picture = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    return np.ascontiguousarray(picture)
