# SPDX-License-Identifier: Apache-2.0
"""StrayScanner: rgb.mp4, depth/, confidence/, odometry.csv, camera_matrix.csv.

Depth are millimetres (PNG, in older recordings .npy) with levels of confidence 0 to 2 beside. odometry.csv tells
timestamp, frame, x y z qx qy qz qw of every frame, camera to world with OpenCV's axes; since 2026 also fx fy cx cy, and
distortion_center_x and _y, whose cells are empty.

The app gives its first frame a time before the beginning of the video, so that an edit list hides it from every player:
rgb.mp4 plays one frame less than odometry.csv has rows, and frame n of the video belongs to row n + 1. A video that was
encoded anew has lost the edit list: then colour is laid on depth both ways.
"""

from __future__ import annotations

import csv
import io
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.poses import quaternion_to_matrix, turning_angle
from ggslam.sequences.alignment import edges_of, outlines_of
from ggslam.sequences.images import read_depth
from ggslam.sequences.json_files import camera_of
from ggslam.sequences.pose_files import invalid_pose_reason, read_matrix
from ggslam.sequences.recording import (
    NO_OPTIONS,
    FrameFiles,
    ReadOptions,
    Recording,
    image_files,
    read_text,
)
from ggslam.sequences.video import Video, VideoFrame
from ggslam.system.tuning import Tuning

POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
INTRINSICS = ("fx", "fy", "cx", "cy")


class StrayTuning(Tuning):
    """How the direction of depth is found."""

    places = 8
    """Frames, the fastest turns of the camera, in which colour is laid on depth both ways."""


class StrayFormat:
    """Frames are those of odometry.csv that have a depth image; colour comes out of the video."""

    name = "strayscanner"
    layout = "rgb.mp4, depth/000000.png, odometry.csv, camera_matrix.csv[, confidence/000000.png]"

    def matches(self, folder: Path) -> bool:
        return (folder / "rgb.mp4").is_file() and (folder / "odometry.csv").is_file()

    def read(self, folder: Path, options: ReadOptions = NO_OPTIONS) -> Recording:
        table = _read_table(folder / "odometry.csv")
        depths = {path.stem: path for path in image_files(folder / "depth", (".png", ".npy"))}
        if not depths:
            raise SequenceError(f"{folder / 'depth'}: no depth images")
        video = Video(folder / "rgb.mp4")
        first, warnings = _first_row(table, depths, video)
        numbers = table["frame"].astype(int)
        rows = [
            i for i, n in enumerate(numbers) if f"{n:06d}" in depths and not _lacks_color(n, first, video, warnings)
        ]
        if not rows:
            raise SequenceError(f"{folder}: no depth image has the number of a frame in odometry.csv")
        table, numbers = {name: values[rows] for name, values in table.items()}, numbers[rows]
        cameras = options.recorded_camera(lambda: _cameras(folder, table, video)) or [None] * len(rows)
        files = []
        for number, camera in zip(numbers, cameras, strict=True):
            confidence = folder / "confidence" / f"{number:06d}.png"
            color = VideoFrame(video, int(number) - first)
            has_confidence = confidence.is_file()
            files.append(
                FrameFiles(color, depths[f"{number:06d}"], None, confidence if has_confidence else None, camera)
            )
        problems = {
            i: f"frame {i}: {folder / 'rgb.mp4'} ends before it, after {video.count} frames"
            for i, number in enumerate(numbers)
            if number - first >= video.count
        }
        recording = Recording(
            self.name, folder, files, table["timestamp"], 1000.0, cameras[0], time_source="odometry.csv",
            problems=problems, warnings=warnings,
        )  # fmt: skip
        options.add_truth(recording, lambda: recording.take_poses(_poses(table), "odometry.csv"))
        return recording


def _first_row(table: dict[str, np.ndarray], depths: dict[str, Path], video: Video) -> tuple[int, list[str]]:
    """Number of the row that the video's first frame belongs to, 0 or 1, and what is said of it."""
    rows = int(table["frame"].max()) + 1
    if video.count != rows - 1:
        return 0, []
    short = f"rgb.mp4 plays {video.count} frames for {rows} rows of odometry.csv, as the app writes it"
    if video.hidden == 1:
        return 1, [f"{short}: its first frame is hidden by an edit list, so row 0 is left out"]
    if _fits_better_one_later(table, depths, video):
        return 1, [f"{short}: colour lies on depth if it is the first that lacks, so row 0 is left out"]
    return 0, [f"{short}: the last one is taken to lack, and row {rows - 1} left out"]


def _lacks_color(number: int, first: int, video: Video, warnings: list[str]) -> bool:
    """Whether a row is the one whose frame lacks in every video of the app."""
    return bool(warnings) and not 0 <= number - first < video.count


def _fits_better_one_later(table: dict[str, np.ndarray], depths: dict[str, Path], video: Video) -> bool:
    """Whether outlines of depth lie on edges of the frame of the video before the one of the same number."""
    poses, numbers = _poses(table), table["frame"].astype(int)
    turns = np.array([turning_angle(a, b) for a, b in pairwise(poses)])
    gain = 0.0
    for row in np.argsort(-np.nan_to_num(turns), kind="stable")[: StrayTuning.places] + 1:
        name = f"{numbers[row]:06d}"
        if name not in depths or not 1 <= numbers[row] < video.count:
            continue
        outlines = outlines_of(read_depth(depths[name], 1000.0)) > 0
        if outlines.any():
            before, same = (_edges_on(video.frame(int(numbers[row]) - back), outlines) for back in (1, 0))
            gain += float(before - same)
    return gain > 0


def _edges_on(color: np.ndarray, outlines: np.ndarray) -> float:
    height, width = outlines.shape
    small = cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA)
    return float(edges_of(small)[outlines].mean())


def _read_table(path: Path) -> dict[str, np.ndarray]:
    """The columns that are read of a CSV file (spaces around names are dropped), float64 [n] each."""
    lines = [row for row in csv.reader(io.StringIO(read_text(path))) if row]
    if len(lines) < 2:
        raise SequenceError(f"{path}: lists no frames")
    names = [name.strip() for name in lines[0]]
    needed = ("timestamp", "frame", *POSE)
    missing = [name for name in needed if name not in names]
    if missing:
        raise SequenceError(f"{path}: column '{missing[0]}' is missing; found {', '.join(names)}")
    for number, row in enumerate(lines[1:], 2):
        if len(row) != len(names):
            raise SequenceError(f"{path}, line {number}: expected {len(names)} numbers, found {len(row)} (truncated?)")
    read = needed + (INTRINSICS if all(name in names for name in INTRINSICS) else ())
    try:
        table = {name: np.array([row[names.index(name)] for row in lines[1:]], float) for name in read}
    except ValueError as error:
        raise SequenceError(f"{path}: {error}") from None
    for name in ("timestamp", "frame"):
        wrong = np.flatnonzero(~(np.abs(table[name]) < 2**53))
        if len(wrong):
            raise SequenceError(f"{path}, line {wrong[0] + 2}: impossible {name} {table[name][wrong[0]]:g}")
    return table


def _cameras(folder: Path, table: dict[str, np.ndarray], video: Video) -> list[Camera | None]:
    """Intrinsics of every frame at the size of the video."""
    height, width = video.frame(0).shape[:2]
    if all(name in table for name in INTRINSICS):
        rows = np.stack([table[name] for name in INTRINSICS], 1).tolist()
        return [camera_of(folder / "odometry.csv", width, height, *row) for row in rows]
    path = folder / "camera_matrix.csv"
    K = read_matrix(path, (3, 3))
    camera = camera_of(path, width, height, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    return [camera] * len(table["frame"])


def _poses(table: dict[str, np.ndarray]) -> np.ndarray:
    poses = np.full((len(table["frame"]), 4, 4), np.nan)
    for i, row in enumerate(np.stack([table[name] for name in POSE], 1)):
        if not np.isfinite(row).all() or np.linalg.norm(row[3:]) < 0.5:
            continue
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = quaternion_to_matrix(row[[6, 3, 4, 5]]), row[:3]
        if invalid_pose_reason(T) is None:
            poses[i] = T
    return poses
