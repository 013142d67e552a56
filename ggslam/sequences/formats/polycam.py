# SPDX-License-Identifier: Apache-2.0
"""Polycam's raw data: keyframes/images, cameras, depth, confidence; corrected_* where Polycam optimised the poses.

A camera file holds fx fy cx cy width height and the rows t_00 ... t_23 of camera to world with ARKit's camera axes.
Depth are millimetres, confidence 0, about 54 and 255 for low, medium and high.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences.images import read_color, read_confidence
from ggslam.sequences.json_files import OPENCV_FROM_OPENGL, camera_of, number_of, read_object
from ggslam.sequences.pose_files import poses_of_frames
from ggslam.sequences.recording import (
    NO_OPTIONS,
    FrameFiles,
    ReadOptions,
    Recording,
    image_files,
    missing_depth_problems,
    nominal_timestamps,
)
from ggslam.system.tuning import Tuning


class ConfidenceTuning(Tuning):
    """From which grey value Polycam's confidence counts as medium and high: half-way between the stored values."""

    medium = 27
    """Smallest grey value of medium confidence."""
    high = 155
    """Smallest grey value of high confidence."""


@dataclass(frozen=True)
class PolycamConfidence:
    """A confidence image whose grey values are turned into levels; see `ImageSource`."""

    path: Path

    @property
    def name(self) -> str:
        return self.path.name

    @property
    def stem(self) -> str:
        return self.path.stem

    def __str__(self) -> str:
        return str(self.path)

    def read(self) -> np.ndarray:
        grey = read_confidence(self.path)
        return (grey >= ConfidenceTuning.medium).astype(np.uint8) + (grey >= ConfidenceTuning.high)


class PolycamFormat:
    """Optimised poses and images are taken where they are there. Every frame has its own intrinsics."""

    name = "polycam"
    layout = "keyframes/ with images/, cameras/, depth/[, confidence/, corrected_images/, corrected_cameras/]"

    def matches(self, folder: Path) -> bool:
        return any((folder / "keyframes" / name).is_dir() for name in ("cameras", "corrected_cameras"))

    def read(self, folder: Path, options: ReadOptions = NO_OPTIONS) -> Recording:
        root = folder / "keyframes"
        corrected = all((root / f"corrected_{name}").is_dir() for name in ("images", "cameras"))
        prefix = "corrected_" if corrected else ""
        colors = image_files(root / f"{prefix}images")
        if not colors:
            raise SequenceError(f"{root / f'{prefix}images'}: no images")
        if not (root / "depth").is_dir():
            raise SequenceError(f"{root / 'depth'}: folder is missing; export the raw data of a LiDAR capture")
        paths = [root / f"{prefix}cameras" / f"{color.stem}.json" for color in colors]
        described = [_read_description(path, options) for path in paths]
        cameras = options.recorded_camera(lambda: _cameras(paths, described, colors[0])) or [None] * len(paths)
        files = [
            FrameFiles(color, root / "depth" / f"{color.stem}.png", None, _confidence(root, color), camera)
            for color, camera in zip(colors, cameras, strict=True)
        ]
        recording = Recording(
            self.name, folder, files, nominal_timestamps(len(files)), 1000.0, cameras[0],
            problems=missing_depth_problems(files),
        )  # fmt: skip
        source = f"{prefix}cameras/*.json (ARKit axes)"
        options.add_truth(recording, lambda: _add_poses(recording, source, paths, described))
        return recording


def _read_description(path: Path, options: ReadOptions) -> dict[str, Any] | None:
    """A camera file; None: it is missing, and a user tells the camera, so that the frame lacks its pose alone."""
    return read_object(path) if path.is_file() else options.recorded_camera(lambda: read_object(path))


def _cameras(paths: list[Path], described: list[dict[str, Any] | None], first: Path) -> list[Camera | None]:
    """Of each frame. Files without width and height are of the size of the images, which `first` tells."""
    size: dict[str, Any] = {}
    if any(values is not None and "width" not in values and "height" not in values for values in described):
        height, width = read_color(first).shape[:2]
        size = {"width": width, "height": height}
    cameras: list[Camera | None] = []
    for path, values in zip(paths, described, strict=True):
        told = values or {}
        told = told if {"width", "height"} & told.keys() else {**size, **told}
        numbers = (number_of(path, told, key) for key in ("width", "height", "fx", "fy", "cx", "cy"))
        cameras.append(camera_of(path, *numbers))
    return cameras


def _confidence(root: Path, color: Path) -> PolycamConfidence | None:
    path = root / "confidence" / f"{color.stem}.png"
    return PolycamConfidence(path) if path.is_file() else None


def _add_poses(
    recording: Recording, source: str, paths: list[Path], described: list[dict[str, Any] | None]
) -> None:
    def pose_of(i: int) -> np.ndarray | None:
        values, T = described[i], np.eye(4)
        if values is None:
            return None
        T[:3] = [[number_of(paths[i], values, f"t_{row}{column}") for column in range(4)] for row in range(3)]
        return T @ OPENCV_FROM_OPENGL

    if any(described):
        poses, problems = poses_of_frames(len(paths), pose_of, paths.__getitem__)
        recording.take_poses(poses, source, problems)
