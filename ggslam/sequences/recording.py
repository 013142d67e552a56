# SPDX-License-Identifier: Apache-2.0
"""What a recording format provides: where the images of each frame are and how to read them."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences.depth_kind import PLAIN, DepthKind
from ggslam.system.plurals import word_for
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import read_untrusted_text

T = TypeVar("T")


class RecordingTuning(Tuning):
    """What is assumed of recordings."""

    rate_hz = 30.0
    """Frames per second of a recording without times."""
    confidence = 1
    """Smallest confidence of a phone's depth: medium drops the fringes around objects and keeps walls."""
    max_digits = 1000
    """Most digits of a number in a file's name; Python refuses to read some thousands."""


Calibration = tuple[float, float, float, float]
"""(fx, fy, cx, cy) in pixels."""

COLOR_SUFFIXES = (".jpg", ".jpeg", ".png")


class ImageSource(Protocol):
    """One image that is no file of its own: it lies in an archive, a video or a bag. `str()` of it tells the container
    and the place in it, for messages. May be read in any order and from several threads."""

    @property
    def name(self) -> str:
        """Name with a suffix, as a file of its own would have it."""
        ...

    @property
    def stem(self) -> str:
        """Name without suffix."""
        ...

    def read(self) -> np.ndarray:
        """Colour uint8 [H, W, 3] RGB; depth uint16 [H, W] or float32 [H, W], in depth units; confidence uint8 [H, W].

        The array may be read-only (a view of a message or of a mapped file), so nobody writes into it; see `Frame`.

        Raises:
            SequenceError: damaged; the message names container and reason.
        """
        ...


class NumberedImage:
    """Name and stem of an `ImageSource` that is one of the frames 0, 1, 2, ... of its container, by `index`."""

    index: int

    @property
    def stem(self) -> str:
        """The number, six digits."""
        return f"{self.index:06d}"

    @property
    def name(self) -> str:
        """The number as the name of a PNG file."""
        return f"{self.stem}.png"


ImageFile = Path | ImageSource
"""An image of a recording, wherever it lies."""


@dataclass(frozen=True)
class FrameFiles:
    """The images of one frame. A path may name a file that is missing; reading it then gives the error.

    Attributes:
        color, depth: the images.
        mask: instance ids.
        confidence: how sure the depth is: 0 low, 1 medium, 2 high.
        camera: intrinsics of this frame's colour image where they change from frame to frame (autofocus, stabilised
            lens); the image is brought to the recording's intrinsics.
    """

    color: ImageFile
    depth: ImageFile
    mask: Path | None = None
    confidence: ImageFile | None = None
    camera: Camera | None = None


@dataclass(frozen=True)
class DepthCamera:
    """A depth camera beside the colour camera; its images are registered to the colour image.

    Attributes:
        camera: intrinsics at the size they were calibrated for.
        T_color_depth: float64 [4, 4], from the depth camera's frame to the colour camera's, OpenCV axes, metres.
        distortion, fisheye: of its lens, as in `Recording`.
    """

    camera: Camera
    T_color_depth: np.ndarray
    distortion: np.ndarray | None = None
    fisheye: bool = False


@dataclass(frozen=True)
class OwnCamera:
    """A colour camera that a user gives; see `own_camera`.

    Attributes:
        source: which argument tells it, for reports.
        camera, calibration, distortion, fisheye: as in `Recording`.
        depth_scale: units of the depth images per metre, or None.
    """

    source: str
    camera: Camera | None
    calibration: Calibration | None
    distortion: np.ndarray | None
    fisheye: bool
    depth_scale: float | None


@dataclass(frozen=True)
class ReadOptions:
    """Properties of a recording that the user gives.

    Attributes:
        depth_camera: YAML file with intrinsics of a depth camera that is not the colour camera, see `calibration`.
        topics: of a bag: role (color, depth, color_info, depth_info, pose) -> topic.
        min_confidence: depth less sure than this (0 to 2) is dropped; None: `RecordingTuning.confidence`.
        own_camera: of colour, instead of what the recording tells.
        depth_scale: units of the depth images per metre, instead of what the recording tells.
        truth: whether true poses are read.
    """

    depth_camera: Path | None = None
    topics: Mapping[str, str] = field(default_factory=dict)
    min_confidence: int | None = None
    own_camera: OwnCamera | None = None
    depth_scale: float | None = None
    truth: bool = True

    def recorded_camera(self, read: Callable[[], T]) -> T | None:
        """What `read` finds in the recording about its colour camera; None where a user tells the camera: then nobody
        looks, for it may be missing.

        Raises:
            SequenceError: of `read`; it names the arguments that would tell the camera.
        """
        if self.own_camera is not None:
            return None
        return _read_with_hint(read, "give the camera with `camera` or `intrinsics`")

    def recorded_scale(self, read: Callable[[], float]) -> float:
        """Units of depth images per metre: what a user tells as such, else what `read` finds, else what a camera file
        tells beside its camera.

        Raises:
            SequenceError: of `read`; it names the argument that would tell the scale.
        """
        if self.depth_scale is not None:
            return self.depth_scale
        of_camera = None if self.own_camera is None else self.own_camera.depth_scale
        try:
            return read()
        except SequenceError as error:
            if of_camera is not None:
                return of_camera
            raise SequenceError(f"{error} (give it with `depth_scale`)") from None

    def add_truth(self, recording: Recording, read: Callable[[], None]) -> None:
        """Lets `read` give a recording its true poses, unless nobody wants them. They serve scores, so that they are
        missing or damaged is a warning, and `Recording.pose_problem`."""
        if not self.truth:
            return
        try:
            read()
        except SequenceError as error:
            recording.lack_poses(str(error))

    def recorded_depth_camera(self, read: Callable[[], T]) -> T | None:
        """What `read` finds about a depth camera beside the colour camera; None where a user tells it.

        Raises:
            SequenceError: of `read`; it names the argument that would tell the camera.
        """
        return None if self.depth_camera is not None else _read_with_hint(read, "give it with `depth_camera`")


def _read_with_hint(read: Callable[[], T], instead: str) -> T:
    try:
        return read()
    except SequenceError as error:
        raise SequenceError(f"{error} ({instead})") from None


NO_OPTIONS = ReadOptions()


@dataclass
class Recording:
    """A recording as its format describes it, before any selection or resizing.

    Attributes:
        format: name of the format.
        path: folder or file of the recording.
        files: one entry per frame, in order of time.
        timestamps: float64 [n], seconds.
        camera: intrinsics of the colour image at the size they were calibrated for; None: the format does not tell the
            size, and `calibration` applies to the size of the colour image.
        calibration: (fx, fy, cx, cy) for the size of the colour image; only when `camera` is None.
        depth_calibration: (fx, fy, cx, cy) for the size of the depth image when it is another camera's.
        depth_scale: depth units per metre.
        depth_kind: what the numbers of depth images mean.
        upright: whether colour images are turned as their orientation tag says.
        void_id: id of masks that means "unlabelled", besides 0; None: none does.
        depth_camera: of depth images that are to be registered to the colour images, or None.
        distortion: OpenCV coefficients (k1, k2, p1, p2, k3[, k4, k5, k6]) of both images (of the colour image alone
            when there is a `depth_camera`), or None.
        fisheye: whether `distortion` are the four coefficients of OpenCV's fisheye model instead.
        min_confidence: depth less sure than this is dropped in frames that have a confidence image.
        poses: float64 [n, 4, 4] T_world_camera with rows of NaN where unknown, or None.
        pose_source: file or folder that the poses come from, for reports.
        pose_problem: why the poses that the recording should have cannot be used; "" where they can.
        camera_source: where the intrinsics come from, for reports; "" where only one place can tell them.
        time_source: where the timestamps come from, for reports.
        depth_delays: float64 [n], seconds at which each frame's depth was taken after its colour; None: not known.
        instance_names: names of mask ids.
        problems: frames known to be damaged without reading their images: frame number -> reason.
        warnings: what a user should know about this recording.
    """

    format: str
    path: Path
    files: list[FrameFiles]
    timestamps: np.ndarray
    depth_scale: float
    camera: Camera | None = None
    calibration: Calibration | None = None
    depth_calibration: Calibration | None = None
    depth_kind: DepthKind = PLAIN
    upright: bool = False
    void_id: int | None = None
    depth_camera: DepthCamera | None = None
    distortion: np.ndarray | None = None
    fisheye: bool = False
    min_confidence: int = RecordingTuning.confidence
    poses: np.ndarray | None = None
    pose_source: str = "none"
    pose_problem: str = ""
    camera_source: str = ""
    time_source: str = f"nominal {RecordingTuning.rate_hz:g} frames/s"
    depth_delays: np.ndarray | None = None
    instance_names: dict[int, str] = field(default_factory=dict)
    problems: dict[int, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def take_poses(self, poses: np.ndarray, source: str, problems: Mapping[int, str] | None = None) -> None:
        """Sets the true poses, float64 [n, 4, 4], rows of NaN where there is none. They serve scores, so what is wrong
        with them, `problems` (what has none -> reason), is a warning; where not one is left, there are none."""
        known = int(np.isfinite(poses).all((1, 2)).sum())
        reasons = list((problems or {}).values())
        first = f"; the first problem: {reasons[0]}" if reasons else ""
        if not known:
            self.lack_poses(f"{source}: no frame has a true pose{first}")
            return
        self.poses, self.pose_source = poses, source
        without = len(poses) - known
        if without or reasons:
            have = word_for(without, "has", "have")
            self.warnings.append(
                f"{source}: {without} of {len(poses)} frames {have} no true pose; scores are over the other "
                f"{known}{first}"
            )

    def lack_poses(self, reason: str) -> None:
        """Notes that the true poses cannot be used."""
        self.poses, self.pose_problem = None, reason
        self.warnings.append(f"no true poses: {reason}")


class RecordingFormat(Protocol):
    """A layout of recordings on disk, in a folder or in one file. Implementations hold no state."""

    name: str
    """Name for `open_sequence(format=...)`."""
    layout: str
    """What the folder or file must hold, in one line, for messages."""

    def matches(self, path: Path, /) -> bool:
        """Whether the folder or file looks like this format (names, or the first bytes of one file)."""
        ...

    def read(self, path: Path, options: ReadOptions = NO_OPTIONS, /) -> Recording:
        """Reads the description of the recording, no images.

        Raises:
            SequenceError: a file is missing or does not follow the format.
            MissingDependency: a package is needed to read it.
        """
        ...


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sorting key that puts "frame2" before "frame10"."""
    parts = [part for part in re.split(r"(\d+)", name) if part]  # numbers of any length: by digits, then by value
    return [(0, len(part.lstrip("0")), part.lstrip("0")) if part.isdigit() else (1, 0, part) for part in parts]


def last_number(name: str) -> int | None:
    """The last run of digits in a name as a number: 12 for "frame-000012.color.png"; None when there is none, or a
    number that no camera counts to."""
    digits = re.findall(r"\d+", name)
    return int(digits[-1]) if digits and len(digits[-1]) <= RecordingTuning.max_digits else None


def image_files(folder: Path, suffixes: tuple[str, ...] = COLOR_SUFFIXES) -> list[Path]:
    """Image files directly in a folder (empty when it does not exist), in natural order, hidden files left out."""
    if not folder.is_dir():
        return []
    found = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith(".")]
    return sorted(found, key=lambda p: natural_key(p.name))


def missing_depth_problems(files: Iterable[FrameFiles]) -> dict[int, str]:
    """Frames whose depth or colour file does not exist: frame number -> reason."""
    problems = {}
    for i, entry in enumerate(files):
        for kind, path in (("colour", entry.color), ("depth", entry.depth)):
            if isinstance(path, Path) and not os.path.isfile(path):  # noqa: PTH113 (Path's raises for impossible names)
                what = "is not a regular file" if os.path.exists(path) else "is missing"  # noqa: PTH110
                problems[i] = f"frame {i}: {kind} file {path} {what}"
    return problems


def image_numbers(files: Iterable[ImageFile]) -> np.ndarray | None:
    """Numbers in the names of images, int64 [n]; None unless each has one and they rise."""
    numbers = [last_number(file.stem) for file in files]
    if any(number is None or number >= 2**53 for number in numbers):
        return None
    found = np.array(numbers, np.int64)
    return found if (np.diff(found) > 0).all() else None


def nominal_timestamps(count: int, rate: float = RecordingTuning.rate_hz) -> np.ndarray:
    """Evenly spaced times, float64 [count], seconds."""
    return np.arange(count, dtype=np.float64) / rate


def read_text(path: Path) -> str:
    """Text of a small file.

    Raises:
        SequenceError: missing, unreadable, too large or not text.
    """
    return read_untrusted_text(path, SequenceError)


def select(path: Path, count: int, start: int, stop: int | None, stride: int) -> range:
    """Numbers start, start + stride, ... below stop (None: to the end) of `count` frames or instants.

    Raises:
        SequenceError: there are none; names `path`.
    """
    if not 0 <= start < count:
        raise SequenceError(f"{path}: start must be from 0 to {count - 1}, found {start}")
    if stride < 1:
        raise SequenceError(f"{path}: stride must be at least 1, found {stride}")
    if stop is not None and stop <= start:
        raise SequenceError(f"{path}: stop must be above start {start}, found {stop}")
    return range(start, count if stop is None else min(stop, count), stride)
