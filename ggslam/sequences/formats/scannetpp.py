# SPDX-License-Identifier: Apache-2.0
"""ScanNet++: the undistorted DSLR images with rendered depth, or the iPhone's colour and LiDAR depth.

Both parts may be in one scene: the given folder is the scene (then the DSLR part is read when its depth is there, else
the iPhone's), or its `dslr` or `iphone`. The iPhone's images are those that the data set's own tools extract (rgb/,
depth/), or its video rgb.mkv together with an extracted depth/. Poses: OpenGL axes in the DSLR part; `aligned_pose`
with OpenCV axes of the iPhone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences.formats.transforms_json import frames_of, read_transforms
from ggslam.sequences.json_files import camera_of, number_of, numbers_of, read_object
from ggslam.sequences.pose_files import poses_of_frames
from ggslam.sequences.recording import (
    NO_OPTIONS,
    FrameFiles,
    ImageFile,
    ReadOptions,
    Recording,
    missing_depth_problems,
    natural_key,
    nominal_timestamps,
)
from ggslam.sequences.video import Video, VideoFrame

DSLR_FILE = Path("nerfstudio") / "transforms_undistorted.json"
IPHONE_FILE = "pose_intrinsic_imu.json"
IPHONE_SIZE: Final = (1920, 1440)
"""(width, height) of the iPhone's colour images, for which its intrinsics hold."""


class ScanNetPlusFormat:
    """Depth in millimetres; DSLR frames marked is_bad are left out."""

    name = "scannet++"
    layout = (
        f"dslr/ with {DSLR_FILE}, undistorted_images/, undistorted_depths/; or iphone/ with {IPHONE_FILE}, rgb/ or "
        "rgb.mkv, depth/"
    )

    def matches(self, folder: Path) -> bool:
        return _dslr(folder) is not None or _iphone(folder) is not None

    def read(self, folder: Path, options: ReadOptions = NO_OPTIONS) -> Recording:
        dslr, iphone = _dslr(folder), _iphone(folder)
        if dslr is not None and ((dslr / "undistorted_depths").is_dir() or iphone is None):
            return self._read_dslr(folder, dslr, options)
        if iphone is None:
            raise SequenceError(f"{folder}: expected {self.layout}")
        return self._read_iphone(folder, iphone, options)

    def _read_dslr(self, folder: Path, root: Path, options: ReadOptions) -> Recording:
        path = root / DSLR_FILE
        content = read_object(path)
        frames = frames_of(path, content)
        if "test_frames" in content:
            frames = frames_of(path, {"frames": frames + frames_of(path, content, "test_frames")})
        frames = [frame for frame in frames if not frame.get("is_bad")]
        images = next(
            (p for p in (root / "undistorted_images", root / "resized_undistorted_images") if p.is_dir()),
            root / "undistorted_images",
        )
        depths = root / "undistorted_depths"
        if not depths.is_dir():
            raise SequenceError(f"{depths}: folder is missing; render the depth images with the data set's own tools")
        return read_transforms(self.name, path, content, frames, folder, images, options, depths)

    def _read_iphone(self, folder: Path, root: Path, options: ReadOptions) -> Recording:
        path = root / IPHONE_FILE
        content = read_object(path)
        names = sorted((name for name in content if isinstance(content[name], dict)), key=natural_key)
        depths = root / "depth"
        if not depths.is_dir():
            raise SequenceError(f"{depths}: folder is missing; extract depth.bin with the data set's own tools")
        numbered = [(i, name) for i, name in enumerate(names) if (depths / f"{name}.png").is_file()]
        if not numbered:
            raise SequenceError(f"{depths}: no image has the name of a frame in {path.name}")
        colors = _iphone_colors(root)
        cameras = options.recorded_camera(lambda: _iphone_cameras(path, content, [name for _, name in numbered]))
        cameras = cameras or [None] * len(numbered)
        files = [
            FrameFiles(colors(i, name), depths / f"{name}.png", camera=camera)
            for (i, name), camera in zip(numbered, cameras, strict=True)
        ]
        recording = Recording(
            self.name, folder, files, nominal_timestamps(len(files)), 1000.0, cameras[0],
            problems=missing_depth_problems(files),
        )  # fmt: skip
        entries = [(name, content[name]) for _, name in numbered]
        _add_iphone_times(recording, path, entries)
        options.add_truth(recording, lambda: _add_iphone_poses(recording, path, entries))
        return recording


def _iphone_colors(root: Path) -> Any:
    """Function (frame number, frame name) -> colour image."""
    videos = [root / name for name in ("rgb.mkv", "rgb.mp4") if (root / name).is_file()]
    if (root / "rgb").is_dir() or not videos:
        return lambda i, name: root / "rgb" / f"{name}.jpg"
    video = Video(videos[0])

    def frame(i: int, name: str) -> ImageFile:
        return VideoFrame(video, i)

    return frame


def _iphone_cameras(path: Path, content: dict[str, Any], names: list[str]) -> list[Camera | None]:
    cameras: list[Camera | None] = []
    for name in names:
        K = numbers_of(f"{path}, {name}", content[name], "intrinsic", 9)
        cameras.append(camera_of(f"{path}, {name}", *IPHONE_SIZE, K[0], K[4], K[2], K[5]))
    return cameras


def _add_iphone_times(recording: Recording, path: Path, frames: list[tuple[str, dict[str, Any]]]) -> None:
    times = [
        number_of(f"{path}, {name}", frame, "timestamp") if "timestamp" in frame else np.nan for name, frame in frames
    ]
    if np.isfinite(times).all() and len(times) > 1 and (np.diff(times) > 0).all():
        recording.timestamps, recording.time_source = np.array(times), path.name


def _add_iphone_poses(recording: Recording, path: Path, frames: list[tuple[str, dict[str, Any]]]) -> None:
    def place_of(i: int) -> str:
        return f"{path}, {frames[i][0]}"

    def pose_of(i: int) -> np.ndarray:
        key = "aligned_pose" if "aligned_pose" in frames[i][1] else "pose"
        return numbers_of(place_of(i), frames[i][1], key, 16).reshape(4, 4)

    poses, problems = poses_of_frames(len(frames), pose_of, place_of)
    recording.take_poses(poses, f"{path.name} (aligned_pose)", problems)


def _dslr(folder: Path) -> Path | None:
    return next((root for root in (folder, folder / "dslr") if (root / DSLR_FILE).is_file()), None)


def _iphone(folder: Path) -> Path | None:
    return next((root for root in (folder, folder / "iphone") if (root / IPHONE_FILE).is_file()), None)
