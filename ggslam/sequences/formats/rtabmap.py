# SPDX-License-Identifier: Apache-2.0
"""What rtabmap-export and RTAB-Map's database viewer write: rgb/, depth/, calib/ and files of poses, maybe all with the
name of the export before them (walk_rgb/, walk_camera_poses.txt).

Images bear the id of their node, or its time. calib/ID.yaml is OpenCV's YAML; some versions write there as
`local_transform` where the camera stands on the robot. *_camera_poses.txt are poses of the camera, *_poses.txt of the
robot. Lines are `time x y z qx qy qz qw`, with the id behind or not, or 12 numbers.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.poses import is_valid_pose
from ggslam.sequences.calibration import camera_entry, distortion_entry, read_calibration
from ggslam.sequences.camera_files.matrices import matrix_numbers
from ggslam.sequences.image_folders import OF_NAMES, pair_folders
from ggslam.sequences.pose_files import (
    PoseRows,
    read_pose_rows,
    take_rows,
    take_rows_by_number,
    take_rows_by_time,
)
from ggslam.sequences.recording import (
    NO_OPTIONS,
    FrameFiles,
    ReadOptions,
    Recording,
    image_files,
    image_numbers,
    missing_depth_problems,
    nominal_timestamps,
)

DEPTH_SCALE: Final = 1000.0
"""Units per metre of RTAB-Map's depth images."""
PARTS = ("rgb", "depth", "calib")
POSES = ("camera_poses.txt", "poses.txt")
"""In the order in which they are looked for."""


class RtabmapFormat:
    """Frames are the nodes of RTAB-Map's graph. Each has its own calibration."""

    name = "rtabmap"
    layout = "rgb/, depth/, calib/ID.yaml (or NAME_rgb/ ...)[; poses.txt or camera_poses.txt] of rtabmap-export"

    def matches(self, folder: Path) -> bool:
        return len(_prefixes(folder)) > 0

    def read(self, folder: Path, options: ReadOptions = NO_OPTIONS) -> Recording:
        prefixes = _prefixes(folder)
        if len(prefixes) != 1:
            found = ", ".join(f"{prefix}rgb" for prefix in prefixes) or "none"
            raise SequenceError(f"{folder}: expected one export with {self.layout}, found {found}")
        rgb, depth, calib = (folder / f"{prefixes[0]}{part}" for part in PARTS)
        pairs = pair_folders(folder, rgb, depth)
        lens = options.recorded_camera(lambda: _lens([_calibration(calib, color) for color in pairs.colors]))
        cameras, (distortion, fisheye) = lens or ([None] * len(pairs.colors), (None, False))
        changing = len(set(cameras)) > 1
        files = [
            FrameFiles(color, depth, camera=camera if changing else None)
            for color, depth, camera in zip(pairs.colors, pairs.depths, cameras, strict=True)
        ]
        times = nominal_timestamps(len(pairs.colors)) if pairs.times is None else pairs.times
        recording = Recording(
            self.name, folder, files, times, DEPTH_SCALE, cameras[0], distortion=distortion, fisheye=fisheye,
            depth_delays=pairs.delays, problems=missing_depth_problems(files), warnings=pairs.warnings,
            camera_source=f"{calib.name}/",
        )  # fmt: skip
        recording.time_source = recording.time_source if pairs.times is None else OF_NAMES
        poses = next((p for name in POSES if (p := folder / f"{prefixes[0]}{name}").is_file()), None)
        if poses is not None:
            options.add_truth(recording, lambda: _add_poses(recording, poses, calib, pairs.colors[0]))
        return recording


def _prefixes(folder: Path) -> list[str]:
    """What stands before `rgb` in the names of an export's folders."""
    if not folder.is_dir():
        return []
    names = [path.name.removesuffix("calib") for path in sorted(folder.glob("*calib")) if any(path.glob("*.yaml"))]
    return [
        name for name in names
        if (not name or name.endswith("_")) and all((folder / f"{name}{part}").is_dir() for part in PARTS)
    ]  # fmt: skip


def _calibration(folder: Path, color: Path) -> tuple[Path, dict[str, Any]]:
    """The file of an image, and its entries; without one of its name that of all, where there is one alone."""
    path = folder / f"{color.stem}.yaml"
    if not path.is_file():
        single = image_files(folder, (".yaml",))
        path = single[0] if len(single) == 1 else path
    return path, read_calibration(path)


def _lens(
    described: list[tuple[Path, dict[str, Any]]],
) -> tuple[list[Camera | None], tuple[np.ndarray | None, bool]]:
    """Cameras of all frames, and the distortion that they share."""
    cameras: list[Camera | None] = [camera_entry(path, settings) for path, settings in described]
    lenses = [distortion_entry(path, settings) for path, settings in described]
    same = {(None if values is None else tuple(values), fisheye) for values, fisheye in lenses}
    if len(same) > 1 or (lenses[0][0] is not None and len(set(cameras)) > 1):
        raise SequenceError(
            f"{described[0][0].parent}: lens distortion or intrinsics of distorted images change from frame to frame: "
            "not supported"
        )
    return cameras, lenses[0]


def _add_poses(recording: Recording, path: Path, calib: Path, first: Path) -> None:
    rows = read_pose_rows(path)
    if not path.name.endswith("camera_poses.txt"):
        settings = _calibration(calib, first)[1]
        rows = _of_camera(rows, settings["local_transform"]) if "local_transform" in settings else rows
    if rows.ids is not None and recording.time_source != OF_NAMES:
        _take_times(recording, rows)
        take_rows_by_number(recording, rows, rows.ids)
    elif rows.stamps is None or recording.time_source != OF_NAMES:
        if rows.stamps is not None and len(rows.poses) != len(recording.files):
            raise SequenceError(
                f"{path}: expected {len(recording.files)} poses, one an image, found {len(rows.poses)}; format 11 "
                "of rtabmap-export names the image of each pose"
            )
        take_rows(recording, rows)
    else:
        take_rows_by_time(recording, rows)


def _of_camera(rows: PoseRows, value: Any) -> PoseRows:
    """Poses of the robot as those of the camera on it."""
    numbers, T_robot_camera = matrix_numbers(f"{rows.path}, local_transform", value), np.eye(4)
    if numbers.size not in (12, 16):
        raise SequenceError(f"{rows.path}: expected 12 numbers of 'local_transform', found {numbers.size}")
    T_robot_camera[: numbers.size // 4] = numbers.reshape(-1, 4)
    if not is_valid_pose(T_robot_camera):
        raise SequenceError(f"{rows.path}: 'local_transform' of the camera is not a rigid transform")
    return replace(rows, poses=rows.poses @ T_robot_camera)


def _take_times(recording: Recording, rows: PoseRows) -> None:
    """Times of the nodes, by their ids; those of nodes without a pose lie between, or go on at the mean pace."""
    assert rows.ids is not None and rows.stamps is not None
    named = image_numbers(entry.color for entry in recording.files)
    known = np.flatnonzero(np.isfinite(rows.ids) & np.isfinite(rows.stamps))
    known = known[np.argsort(rows.ids[known], kind="stable")]
    ids, stamps = rows.ids[known], rows.stamps[known]
    if named is None or len(ids) < 2 or not (np.diff(ids) > 0).all() or not (np.diff(stamps) > 0).all():
        return
    pace = (stamps[-1] - stamps[0]) / (ids[-1] - ids[0])
    beyond = np.minimum(named - ids[0], 0) + np.maximum(named - ids[-1], 0)
    recording.timestamps = np.interp(named, ids, stamps) + pace * beyond
    recording.time_source = rows.path.name
