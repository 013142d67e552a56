# SPDX-License-Identifier: Apache-2.0
"""transforms.json with depth, as nerfstudio's tools, NeRFCapture and instant-ngp write it.

    {"fl_x": ..., "fl_y": ..., "cx": ..., "cy": ..., "w": ..., "h": ..., "camera_model": "OPENCV", "k1": ...,
     "frames": [{"file_path": "images/0.png", "depth_file_path": "depth/0.png", "transform_matrix": 4x4}, ...]}

Intrinsics may stand in each frame instead. Poses map camera to world with OpenGL's camera axes. The principal point
counts from the corner of the image, half a pixel further than ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences.json_files import OPENCV_FROM_OPENGL, camera_of, number_of, numbers_of, read_object
from ggslam.sequences.pose_files import poses_of_frames
from ggslam.sequences.recording import (
    NO_OPTIONS,
    FrameFiles,
    ReadOptions,
    Recording,
    missing_depth_problems,
    natural_key,
    nominal_timestamps,
)

FILE = "transforms.json"
DEPTH_KEYS = ("depth_file_path", "depth_path")
"""nerfstudio's and NeRFCapture's names of the same entry."""
INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h")
MODELS = {
    "PINHOLE": (), "SIMPLE_PINHOLE": (), "OPENCV": ("k1", "k2", "p1", "p2", "k3"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}  # fmt: skip
"""Camera models and their coefficients in OpenCV's order."""


class TransformsFormat:
    """Frames in the order of time where they carry timestamps, else of the names of their images."""

    name = "nerfstudio"
    layout = f"{FILE} (nerfstudio, NeRFCapture) with depth_file_path or depth_path in its frames"

    def matches(self, folder: Path) -> bool:
        return (folder / FILE).is_file()

    def read(self, folder: Path, options: ReadOptions = NO_OPTIONS) -> Recording:
        path = folder / FILE
        content = read_object(path)
        return read_transforms(self.name, path, content, frames_of(path, content), folder, folder, options)


def frames_of(path: Path, content: dict[str, Any], key: str = "frames") -> list[dict[str, Any]]:
    """The frames listed, each an object with a file_path, in order.

    Raises:
        SequenceError: there is no such list.
    """
    frames = content.get(key)
    listed: list[dict[str, Any]] = frames if isinstance(frames, list) else []
    described = all(isinstance(frame, dict) and isinstance(frame.get("file_path"), str) for frame in listed)
    if not isinstance(frames, list) or not described:
        raise SequenceError(f"{path}: expected '{key}' to list objects with file_path and transform_matrix")
    if all(isinstance(f.get("timestamp"), (int, float)) for f in listed):
        return sorted(listed, key=lambda f: f["timestamp"])
    return sorted(listed, key=lambda f: natural_key(f["file_path"]))


def read_transforms(
    name: str, path: Path, content: dict[str, Any], frames: list[dict[str, Any]], folder: Path, images: Path,
    options: ReadOptions = NO_OPTIONS, depths: Path | None = None,
) -> Recording:  # fmt: skip
    """The recording that a transforms file describes.

    Args:
        name: of the format.
        path, content: the file.
        frames: the frames of it to take, in order.
        folder: of the recording.
        images: folder that the paths of images start from.
        options: of the user.
        depths: folder with a depth image of the name of each colour image; None: the frames tell their depth images.

    Raises:
        SequenceError: an entry is missing or wrong.
    """
    lens = options.recorded_camera(lambda: _lens(path, content, frames)) or _Lens(None, [None] * len(frames))
    files = [
        FrameFiles(_image(images / frame["file_path"]), _depth(path, frame, images, depths), None, None, camera)
        for frame, camera in zip(frames, lens.changing, strict=True)
    ]
    times = [frame.get("timestamp") for frame in frames]
    told = bool(times) and all(isinstance(t, (int, float)) for t in times)
    recording = Recording(
        name, folder, files, np.array(times, float) if told else nominal_timestamps(len(files)),
        options.recorded_scale(lambda: _depth_scale(path, content, depths is None)), lens.common,
        distortion=lens.distortion, fisheye=lens.fisheye,
        problems=missing_depth_problems(files),
    )  # fmt: skip
    if told:
        recording.time_source = path.name
    options.add_truth(recording, lambda: _add_poses(recording, path, frames))
    return recording


@dataclass(frozen=True)
class _Lens:
    """The camera of all frames, that of each frame where it changes, and the distortion."""

    common: Camera | None
    changing: list[Camera | None]
    distortion: np.ndarray | None = None
    fisheye: bool = False


def _lens(path: Path, content: dict[str, Any], frames: list[dict[str, Any]]) -> _Lens:
    own = [_own_camera(path, content, frame) for frame in frames]
    common = own[0] if frames and own[0] is not None else _camera(path, content)
    distortion, fisheye = _distortion(path, content)
    changing = any(camera is not None and camera != common for camera in own)
    if changing and distortion is not None:
        raise SequenceError(f"{path}: intrinsics change from frame to frame and there is distortion: not supported")
    return _Lens(common, own if changing else [None] * len(frames), distortion, fisheye)


def _image(path: Path) -> Path:
    """NeRFCapture leaves the suffix out."""
    if path.suffix:
        return path
    named = [path.with_name(path.name + suffix) for suffix in (".png", ".jpg")]
    return next((candidate for candidate in named if candidate.is_file()), named[0])


def _depth(path: Path, frame: dict[str, Any], images: Path, depths: Path | None) -> Path:
    if depths is not None:
        return depths / f"{Path(frame['file_path']).stem}.png"
    told = next((frame[key] for key in DEPTH_KEYS if isinstance(frame.get(key), str)), None)
    if told is None:
        raise SequenceError(
            f"{path}: frame {frame['file_path']} has no {' or '.join(DEPTH_KEYS)}: a recording without depth cannot be "
            "used"
        )
    return _image(images / told)


def _camera(path: Path, values: dict[str, Any]) -> Camera:
    fx, fy, cx, cy, width, height = (number_of(path, values, key) for key in INTRINSICS)
    return camera_of(path, width, height, fx, fy, cx - 0.5, cy - 0.5)


def _own_camera(path: Path, content: dict[str, Any], frame: dict[str, Any]) -> Camera | None:
    """Intrinsics that stand in the frame (what is missing there, as the size, stands at the top)."""
    return _camera(path, {**content, **frame}) if "fl_x" in frame else None


def _distortion(path: Path, content: dict[str, Any]) -> tuple[np.ndarray | None, bool]:
    model = content.get("camera_model", "OPENCV")
    if model not in MODELS:
        raise SequenceError(f"{path}: camera_model {model} is not supported; known: {', '.join(MODELS)}")
    values = np.array([number_of(path, content, key) if key in content else 0.0 for key in MODELS[model]])
    if model == "OPENCV" and content.get("k4"):
        raise SequenceError(f"{path}: camera_model OPENCV with k4 is not supported")
    return (values if np.any(values) else None), model == "OPENCV_FISHEYE"


def _depth_scale(path: Path, content: dict[str, Any], own: bool) -> float:
    """Depth units per metre; files tell metres per unit."""
    for key in ("depth_unit_scale_factor", "integer_depth_scale"):
        if own and key in content:
            scale = number_of(path, content, key)
            if scale <= 0:
                raise SequenceError(f"{path}: expected '{key}' to be positive, found {scale:g}")
            return 1.0 / scale
    return 1000.0


def _add_poses(recording: Recording, path: Path, frames: list[dict[str, Any]]) -> None:
    def place_of(i: int) -> str:
        return f"{path}, frame {frames[i]['file_path']}"

    def pose_of(i: int) -> np.ndarray:
        return numbers_of(place_of(i), frames[i], "transform_matrix", 16).reshape(4, 4) @ OPENCV_FROM_OPENGL

    poses, problems = poses_of_frames(len(frames), pose_of, place_of)
    recording.take_poses(poses, f"{path.name} (OpenGL axes)", problems)
