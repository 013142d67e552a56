# SPDX-License-Identifier: Apache-2.0
"""Live cameras: their interface, how they are opened by name, and how a run reads one.

Anything with a camera and an iterator of frames is a source:

    class Webcam:
        name = "webcam"
        camera = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
        def frames(self): ...          # yields Frame(index, source_index, timestamp, color, depth, camera)
        def close(self): ...

`ggslam run python:my_module:Webcam` runs it, `Slam(source.camera)` and `slam.step(frame)` do the same from Python.
"""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, Final, Literal, Protocol, runtime_checkable

import cv2
import numpy as np
import yaml

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.sequences.sequence import SkippedFrame
from ggslam.system.atomic import make_folder, write_bytes, write_text
from ggslam.system.named_code import load_named
from ggslam.system.tuning import Tuning

SCHEMES = ("realsense", "ros2", "python")
DEPTH_SCALE: Final = 1000.0
"""Units per metre of recorded depth images: this is our own format."""


class LiveTuning(Tuning):
    """What is taken for the time of a picture."""

    late_s = 10.0
    """Seconds after its stamp up to which a frame may come for the stamp to be of the wall clock."""
    early_s = 1.0
    """Seconds before it: clocks of two machines differ."""
    warnings = 100
    """Things that are told in all; then it is quiet."""


@runtime_checkable
class LiveSource(Protocol):
    """A live RGB-D camera.

    Attributes:
        name: for the run folder.
        camera: of all frames: pinhole, colour and depth registered to each other.
    """

    name: str
    camera: Camera

    def frames(self) -> Iterator[Frame]:
        """Frames with indices 0, 1, 2, ...: the newest one each time, older ones are dropped while nobody asks."""
        ...

    def close(self) -> None:
        """Stops the camera."""
        ...


@runtime_checkable
class WaitingSource(LiveSource, Protocol):
    """A source that may wait long for the next frame, and drops what nobody took.

    Attributes:
        arrived: when the last frame was there, seconds since 1970.
    """

    arrived: float

    def follow(self, going_on: Callable[[], bool], say: Callable[[str], None]) -> None:
        """While nothing comes, frames are waited for as long as `going_on()`; `say` is told what happens."""
        ...

    def counts(self) -> dict[str, int]:
        """What came and what became of it, so far."""
        ...

    def reasons(self) -> dict[str, int]:
        """Why images were left out, and how often."""
        ...


def is_live(place: str | Path) -> bool:
    """Whether a text names a live source: "realsense:", "realsense:SERIAL", "ros2://COLOR,DEPTH" (see
    `formats.ros2_address`), "python:MODULE:CALLABLE" (or python:FILE.py:CALLABLE)."""
    scheme, colon, _ = str(place).partition(":")
    return bool(colon) and scheme in SCHEMES


def open_live(place: str | Path, scale: float = 1.0) -> LiveSource:
    """Starts a live source.

    Args:
        place: see `is_live`. The callable of a python source gets no argument and returns a `LiveSource`.
        scale: size of the delivered images, in (0, 1]; a python source sizes its images itself.

    Raises:
        MissingDependency: a package is needed for it.
        SequenceError: there is no such source, or no camera.
    """
    scheme, _, rest = str(place).partition(":")
    if scheme == "realsense":
        from ggslam.sequences.formats.realsense import RealSenseCamera

        return RealSenseCamera(rest, scale)
    if scheme == "ros2":
        from ggslam.sequences.formats.ros2_topics import Ros2Camera

        return Ros2Camera(str(place), scale)
    if scheme != "python":
        raise SequenceError(f"{place}: expected a live source of {', '.join(f'{name}:' for name in SCHEMES)}")
    return _call(str(place), rest)


def _call(place: str, name: str) -> LiveSource:
    try:
        make = load_named(name)
        source = make() if callable(make) else make
    except (ImportError, AttributeError, ValueError) as error:
        raise SequenceError(f"{place}: expected python:MODULE:CALLABLE: {error}") from None
    if not isinstance(source, LiveSource):
        raise SequenceError(f"{place}: expected name, camera, frames() and close(), found {type(source).__name__}")
    return source


class LiveSequence:
    """A live source with the interface of a sequence. It ends on request, with Ctrl-C or after `stop` frames.

    Args:
        source: the camera.
        stop: number of frames; None: until Ctrl-C or until the source ends.
        record: folder that frames are written to as they come, a plain folder that can be opened later.

    Attributes:
        say: is told what happens to the camera meanwhile; `warnings` keep it.
        goes_on: whether frames are still waited for while none comes.
        since: what `moment_of` tells: "stamp", where stamps are of the wall clock, else "arrival".
    """

    format = "live"
    has_masks = False
    time_source = "the camera's clock"

    def __init__(self, source: LiveSource, stop: int | None = None, record: Path | None = None) -> None:
        self.source, self.name, self.camera, self.native_camera = source, source.name, source.camera, source.camera
        self.path = Path(source.name) if record is None else record
        self.record, self._stop = record, stop
        self.warnings: list[str] = list(getattr(source, "warnings", ()))
        self.say: Callable[[str], None] = lambda text: None
        self.goes_on: Callable[[], bool] = lambda: True
        self.since: Literal["", "stamp", "arrival"] = ""
        self.skipped_frames: list[SkippedFrame] = []
        self.mask_problems: dict[int, str] = {}
        self.instance_names: dict[int, str] = {}
        self._times: list[float] = []
        self._taken: list[float] = []
        self._ended = threading.Event()
        if record is not None:
            _begin_recording(record, source.camera)

    def __len__(self) -> int:
        return len(self._times) if self._stop is None else self._stop

    def end(self, *_: int | FrameType | None) -> None:
        """Lets the stream end after the frame in work."""
        self._ended.set()

    def stream(self, prefetch: int = 0, masks: Any = False) -> Iterator[Frame]:
        """Frames as they come (there is nothing to read ahead); the camera is stopped at the end."""
        in_main = threading.current_thread() is threading.main_thread()
        before = signal.signal(signal.SIGINT, self.end) if in_main else None
        if isinstance(self.source, WaitingSource):
            self.source.follow(lambda: self.goes_on() and not self._ended.is_set(), self._note)
        try:
            for frame in self.source.frames():
                self._times.append(frame.timestamp)
                self._note_time(frame)
                if self.record is not None:
                    _record(self.record, frame)
                    _record_time(self.record, frame)  # one by one: a run that is killed keeps what it recorded
                yield frame
                if self._ended.is_set() or (self._stop is not None and len(self._times) >= self._stop):
                    break
        finally:
            if in_main:
                signal.signal(signal.SIGINT, before)
            self.source.close()

    def _note(self, text: str) -> None:
        if len(self.warnings) < LiveTuning.warnings:
            self.warnings.append(text)
            self.say(text)

    def _note_time(self, frame: Frame) -> None:
        arrived = self.source.arrived if isinstance(self.source, WaitingSource) else time.time()
        good = -LiveTuning.early_s < arrived - frame.timestamp < LiveTuning.late_s
        self.since = self.since or ("stamp" if good else "arrival")
        by_stamp = frame.timestamp if good else math.nan  # its clock was set, or jumped
        self._taken.append(by_stamp if self.since == "stamp" else arrived)

    def moment_of(self, frame: Frame) -> float:
        """When a frame was taken, or came, seconds since 1970; see `since`. NaN: its stamp cannot be true."""
        return self._taken[frame.index]

    def counts(self) -> dict[str, int] | None:
        """What came and what became of it; None: the source does not tell."""
        return self.source.counts() if isinstance(self.source, WaitingSource) else None

    def reasons(self) -> dict[str, int]:
        """Why images were left out, and how often."""
        return self.source.reasons() if isinstance(self.source, WaitingSource) else {}


def _begin_recording(folder: Path, camera: Camera) -> None:
    if folder.exists() and any(folder.iterdir()):
        raise SequenceError(f"{folder}: not empty; frames are recorded into a new folder")
    make_folder(folder / "rgb")
    make_folder(folder / "depth")
    entries = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    write_text(folder / "camera.yaml", yaml.safe_dump({**entries, "depth_scale": DEPTH_SCALE}, sort_keys=False))


def _record_time(folder: Path, frame: Frame) -> None:
    with (folder / "timestamps.txt").open("a") as times:
        times.write(f"{frame.timestamp:.6f}\n")


def _record(folder: Path, frame: Frame) -> None:
    depth = np.clip(np.rint(frame.depth * DEPTH_SCALE), 0, 65535).astype(np.uint16)
    color = cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR)
    for name, image in (("rgb", color), ("depth", depth)):
        write_bytes(folder / name / f"{frame.index:06d}.png", cv2.imencode(".png", image)[1].tobytes())
