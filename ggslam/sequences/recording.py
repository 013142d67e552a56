# SPDX-License-Identifier: Apache-2.0
"""What a recording format hands over: where the files of each frame are and how to read them."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera

NOMINAL_RATE = 30.0
"""Frames per second assumed when a recording tells no time."""

Calibration = tuple[float, float, float, float]
"""(fx, fy, cx, cy) in pixels."""

COLOR_SUFFIXES = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True)
class FrameFiles:
    """The files of one frame. A path may name a file that is missing; reading it then gives the error."""

    color: Path
    depth: Path
    mask: Path | None = None


@dataclass
class Recording:
    """A recording as its format describes it, before any selection or resizing.

    Attributes:
        format: name of the format.
        path: folder of the recording.
        files: one entry per frame, in order of time.
        timestamps: float64 [n], seconds.
        camera: intrinsics of the colour image at the size they were calibrated for; None: the format does not tell the
            size, and `calibration` applies to the size of the colour image.
        calibration: (fx, fy, cx, cy) for the size of the colour image; only when `camera` is None.
        depth_calibration: (fx, fy, cx, cy) for the size of the depth image when it is another camera's.
        depth_scale: depth units per metre.
        invalid_depth: raw depth value that means "nothing measured" beside 0, or None.
        distortion: OpenCV coefficients (k1, k2, p1, p2, k3) of both images, or None.
        poses: float64 [n, 4, 4] T_world_camera with rows of NaN where unknown, or None.
        pose_source: file or folder that told the poses, for reports.
        time_source: what told the time, for reports.
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
    invalid_depth: int | None = None
    distortion: np.ndarray | None = None
    poses: np.ndarray | None = None
    pose_source: str = "none"
    time_source: str = f"nominal {NOMINAL_RATE:g} frames/s"
    instance_names: dict[int, str] = field(default_factory=dict)
    problems: dict[int, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


class RecordingFormat(Protocol):
    """One way of laying a recording out on disk. Implementations hold no state."""

    name: str
    """Name for `open_sequence(format=...)`."""
    layout: str
    """What the folder must hold, in one line, for messages."""

    def matches(self, folder: Path) -> bool:
        """Whether the folder looks like this format (only names of files are looked at)."""
        ...

    def read(self, folder: Path) -> Recording:
        """Reads the description of the recording, no images.

        Raises:
            SequenceError: a file is missing or does not follow the format.
        """
        ...


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sorting key that puts "frame2" before "frame10"."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", name) if part]


def last_number(name: str) -> int | None:
    """The last run of digits in a name as a number: 12 for "frame-000012.color.png"; None when there is none."""
    digits = re.findall(r"\d+", name)
    return int(digits[-1]) if digits else None


def image_files(folder: Path, suffixes: tuple[str, ...] = COLOR_SUFFIXES) -> list[Path]:
    """Image files directly in a folder (empty when it does not exist), in natural order, hidden files left out."""
    if not folder.is_dir():
        return []
    found = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith(".")]
    return sorted(found, key=lambda p: natural_key(p.name))


def missing_depth_problems(files: list[FrameFiles]) -> dict[int, str]:
    """Frames whose depth or colour file does not exist: frame number -> reason."""
    problems = {}
    for i, entry in enumerate(files):
        for kind, path in (("colour", entry.color), ("depth", entry.depth)):
            if not path.is_file():
                problems[i] = f"frame {i}: {kind} file {path} is missing"
    return problems


def nominal_timestamps(count: int, rate: float = NOMINAL_RATE) -> np.ndarray:
    """Evenly spaced times, float64 [count], seconds."""
    return np.arange(count, dtype=np.float64) / rate


def read_text(path: Path) -> str:
    """Text of a small file.

    Raises:
        SequenceError: missing, unreadable or not text.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise SequenceError(f"{path}: file is missing") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SequenceError(f"{path}: cannot be read as text: {error}") from None
