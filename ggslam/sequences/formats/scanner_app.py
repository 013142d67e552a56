# SPDX-License-Identifier: Apache-2.0
"""3D Scanner App (Laan Labs), "All Data": frame_00000.jpg and .json, depth_00000.png, conf_00000.png, info.json.

A frame's JSON holds `intrinsics` (9 numbers, row by row, of the colour image), `cameraPoseARFrame` (16 numbers, row by
row, camera to world with ARKit's axes for images as the sensor lies: x right, y up, z backwards) and `time` (seconds
since the device was started). Depth are millimetres with levels of confidence 0 to 2 beside, written where a scan was
made at low resolution. The app writes depth and JSON of every frame, but colour of some frames only.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences.images import read_color
from ggslam.sequences.json_files import OPENCV_FROM_OPENGL, camera_of, number_of, numbers_of, read_object
from ggslam.sequences.pose_files import poses_of_frames
from ggslam.sequences.recording import (
    NO_OPTIONS,
    FrameFiles,
    ReadOptions,
    Recording,
    nominal_timestamps,
)

NAMES = re.compile(r"(frame|depth|conf)_(\d+)\.(jpg|jpeg|json|png)")


class ScannerAppFormat:
    """Frames are those with colour, depth and JSON. Every frame has its own intrinsics."""

    name = "3dscannerapp"
    layout = "frame_00000.jpg, frame_00000.json, depth_00000.png[, conf_00000.png, info.json]"

    def matches(self, folder: Path) -> bool:
        return any(folder.glob("frame_*.json")) and any(folder.glob("depth_*.png"))

    def read(self, folder: Path, options: ReadOptions = NO_OPTIONS) -> Recording:
        files = _files_by_kind(folder)
        whole = sorted(files["color"].keys() & files["depth"].keys() & files["json"].keys())
        if not whole:
            found = ", ".join(f"{len(by_number)} {kind}" for kind, by_number in files.items())
            raise SequenceError(
                f"{folder}: no frame has colour, depth and JSON (files found: {found}); the app writes depth "
                "of scans at low resolution, shared as All Data"
            )
        paths = [files["json"][number] for number in whole]
        described = [read_object(path) for path in paths]
        cameras = options.recorded_camera(lambda: _cameras(files["color"][whole[0]], paths, described))
        cameras = cameras or [None] * len(whole)
        frames = [
            FrameFiles(files["color"][n], files["depth"][n], None, files["confidence"].get(n), camera)
            for n, camera in zip(whole, cameras, strict=True)
        ]
        timed = all("time" in values for values in described)
        times = [number_of(path, values, "time") for path, values in zip(paths, described, strict=True) if timed]
        recording = Recording(
            self.name, folder, frames, np.array(times) if timed else nominal_timestamps(len(frames)), 1000.0,
            cameras[0], warnings=_warnings(files, len(whole)),
        )  # fmt: skip
        if timed:
            recording.time_source = "frame_*.json, time"
        source = "frame_*.json, cameraPoseARFrame (ARKit axes)"
        options.add_truth(recording, lambda: _add_poses(recording, source, paths, described))
        return recording


def _files_by_kind(folder: Path) -> dict[str, dict[int, Path]]:
    """Files by their frame's number: color, depth, json, confidence."""
    files: dict[str, dict[int, Path]] = {"color": {}, "depth": {}, "json": {}, "confidence": {}}
    kinds = {
        ("frame", "jpg"): "color", ("frame", "jpeg"): "color", ("frame", "json"): "json", ("depth", "png"): "depth",
        ("conf", "png"): "confidence",
    }  # fmt: skip
    for path in sorted(folder.iterdir()):
        match = NAMES.fullmatch(path.name)
        kind = kinds.get((match[1], match[3])) if match else None
        if match and kind:
            files[kind][int(match[2])] = path
    return files


def _warnings(files: dict[str, dict[int, Path]], used: int) -> list[str]:
    every = len(files["color"].keys() | files["depth"].keys())
    if every == used:
        return []
    lacking = {
        "colour": len(files["depth"].keys() - files["color"].keys()),
        "depth": len(files["color"].keys() - files["depth"].keys()),
        "JSON": len((files["color"].keys() & files["depth"].keys()) - files["json"].keys()),
    }
    words = ", ".join(f"{count} without {what}" for what, count in lacking.items() if count)
    return [f"{used} of {every} frames are whole, as the app writes it; left out: {words}"]


def _cameras(color: Path, paths: list[Path], described: list[dict[str, Any]]) -> list[Camera | None]:
    height, width = read_color(color).shape[:2]
    cameras: list[Camera | None] = []
    for path, values in zip(paths, described, strict=True):
        K = numbers_of(path, values, "intrinsics", 9).reshape(3, 3)
        cameras.append(camera_of(path, width, height, *(float(K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))))
    return cameras


def _add_poses(recording: Recording, source: str, paths: list[Path], described: list[dict[str, Any]]) -> None:
    def pose_of(i: int) -> np.ndarray:
        return numbers_of(paths[i], described[i], "cameraPoseARFrame", 16).reshape(4, 4) @ OPENCV_FROM_OPENGL

    poses, problems = poses_of_frames(len(paths), pose_of, paths.__getitem__)
    recording.take_poses(poses, source, problems)
