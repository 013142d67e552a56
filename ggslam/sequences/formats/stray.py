# SPDX-License-Identifier: Apache-2.0
"""StrayScanner: rgb.mp4, depth/, confidence/, odometry.csv, camera_matrix.csv.

Depth are millimetres (PNG, in older recordings .npy) with levels of confidence 0 to 2 beside. odometry.csv tells
timestamp, frame, x y z qx qy qz qw of every frame of the video, camera to world with OpenCV's axes, in newer recordings
fx fy cx cy too.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.poses import quaternion_to_matrix
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

POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
INTRINSICS = ("fx", "fy", "cx", "cy")


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
        rows = [i for i, number in enumerate(table["frame"].astype(int)) if f"{number:06d}" in depths]
        if not rows:
            raise SequenceError(f"{folder}: no depth image has the number of a frame in odometry.csv")
        table = {name: values[rows] for name, values in table.items()}
        cameras = _cameras(folder, table, video)
        files = []
        for number, camera in zip(table["frame"].astype(int), cameras, strict=True):
            confidence = folder / "confidence" / f"{number:06d}.png"
            has_confidence = confidence.is_file()
            files.append(
                FrameFiles(
                    VideoFrame(video, int(number)), depths[f"{number:06d}"], None,
                    confidence if has_confidence else None, camera,
                )
            )  # fmt: skip
        problems = {
            i: f"frame {i}: {folder / 'rgb.mp4'} ends before it, after {video.count} frames"
            for i, number in enumerate(table["frame"].astype(int))
            if number >= video.count
        }
        return Recording(
            self.name, folder, files, table["timestamp"], 1000.0, cameras[0], poses=_poses(table),
            pose_source="odometry.csv", time_source="odometry.csv", problems=problems,
        )  # fmt: skip


def _read_table(path: Path) -> dict[str, np.ndarray]:
    """Columns of a CSV file by name (spaces around names are dropped), float64 [n] each."""
    lines = [row for row in csv.reader(io.StringIO(read_text(path))) if row]
    if len(lines) < 2:
        raise SequenceError(f"{path}: lists no frames")
    names = [name.strip() for name in lines[0]]
    missing = [name for name in ("timestamp", "frame", *POSE) if name not in names]
    if missing:
        raise SequenceError(f"{path}: column '{missing[0]}' is missing; found {', '.join(names)}")
    for number, row in enumerate(lines[1:], 2):
        if len(row) != len(names):
            raise SequenceError(f"{path}, line {number}: expected {len(names)} numbers, found {len(row)} (truncated?)")
    try:
        table = np.array(lines[1:], float)
    except ValueError as error:
        raise SequenceError(f"{path}: {error}") from None
    return dict(zip(names, table.T, strict=True))


def _cameras(folder: Path, table: dict[str, np.ndarray], video: Video) -> list[Camera]:
    """Intrinsics of every frame at the size of the video."""
    height, width = video.frame(int(table["frame"][0])).shape[:2]
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
