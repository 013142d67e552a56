# SPDX-License-Identifier: Apache-2.0
"""Live cameras: what one has to offer, opening one by its name, and a run's view of one.

Anything with a camera and an iterator of frames is a source:

    class Webcam:
        name = "webcam"
        camera = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
        def frames(self): ...          # yields Frame(index, source_index, timestamp, color, depth, camera)
        def close(self): ...

`ggslam run python:my_module:Webcam` runs it, `Slam(source.camera)` and `slam.step(frame)` do the same from Python.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any, Final, Protocol, runtime_checkable

import cv2
import numpy as np
import yaml

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.sequences.sequence import SkippedFrame
from ggslam.system.atomic import make_folder, write_bytes, write_text
from ggslam.system.named_code import load_named

SCHEMES = ("realsense", "python")
DEPTH_SCALE: Final = 1000.0
"""Units per metre of recorded depth images: this is our own format."""


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


def is_live(place: str | Path) -> bool:
    """Whether a text names a live source: "realsense:", "realsense:SERIAL", "python:MODULE:CALLABLE" (or
    python:FILE.py:CALLABLE)."""
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
    """A live source as a run sees it: a sequence that ends on request, with Ctrl-C or after `stop` frames.

    Args:
        source: the camera.
        stop: number of frames; None: until Ctrl-C or until the source ends.
        record: folder that frames are written to as they come, a plain folder that can be opened later.
    """

    format = "live"
    has_masks = False
    time_source = "the camera's clock"

    def __init__(self, source: LiveSource, stop: int | None = None, record: Path | None = None) -> None:
        self.source, self.name, self.camera, self.native_camera = source, source.name, source.camera, source.camera
        self.path = Path(source.name) if record is None else record
        self.record, self._stop = record, stop
        self.warnings: list[str] = []
        self.skipped_frames: list[SkippedFrame] = []
        self.mask_problems: dict[int, str] = {}
        self.instance_names: dict[int, str] = {}
        self._times: list[float] = []
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
        try:
            for frame in self.source.frames():
                self._times.append(frame.timestamp)
                if self.record is not None:
                    _record(self.record, frame)
                yield frame
                if self._ended.is_set() or (self._stop is not None and len(self._times) >= self._stop):
                    break
        finally:
            if in_main:
                signal.signal(signal.SIGINT, before)
            self.source.close()
            if self.record is not None:
                write_text(self.record / "timestamps.txt", "".join(f"{time:.6f}\n" for time in self._times))


def _begin_recording(folder: Path, camera: Camera) -> None:
    if folder.exists() and any(folder.iterdir()):
        raise SequenceError(f"{folder}: not empty; frames are recorded into a new folder")
    make_folder(folder / "rgb")
    make_folder(folder / "depth")
    entries = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    write_text(folder / "camera.yaml", yaml.safe_dump({**entries, "depth_scale": DEPTH_SCALE}, sort_keys=False))


def _record(folder: Path, frame: Frame) -> None:
    depth = np.clip(np.rint(frame.depth * DEPTH_SCALE), 0, 65535).astype(np.uint16)
    color = cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR)
    for name, image in (("rgb", color), ("depth", depth)):
        write_bytes(folder / name / f"{frame.index:06d}.png", cv2.imencode(".png", image)[1].tobytes())
