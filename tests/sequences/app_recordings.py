# SPDX-License-Identifier: Apache-2.0
"""A generated room as phones' apps would have written it: names, tables, units, axes and sizes are theirs.

The facts are of the apps' own sources and documents and of their users' readers: StrayScanner's encoders and format.md,
Record3D's answers to its users, files of 3D Scanner App's "All Data". One thing is not theirs: the codec of rgb.mp4,
which is HEVC.
"""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ggslam.scene.camera import Camera
from ggslam.synthetic.raycast import RayCaster
from ggslam.synthetic.room import furnished_room
from ggslam.synthetic.scene import Scene
from ggslam.synthetic.trajectory import camera_path

FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
"""Turns a camera with y down and z forward into ARKit's, with y up and z backwards, and back."""
DEPTH_SIZE = (256, 192)


@dataclass(frozen=True)
class PhoneFrame:
    """What a phone measures at one moment.

    Attributes:
        time: seconds.
        color: uint8 [H, W, 3] RGB.
        depth: float32 [192, 256] metres (or the size that was asked for).
        confidence: uint8, 0 to 2.
        camera: of the colour image.
        T_world_camera: with OpenCV's axes.
    """

    time: float
    color: np.ndarray
    depth: np.ndarray
    confidence: np.ndarray
    camera: Camera
    T_world_camera: np.ndarray


def phone_frames(
    count: int, size: tuple[int, int] = (1920, 1440), depth_size: tuple[int, int] = DEPTH_SIZE, frames: int = 300,
    color_later: float = 0.0, focal: float = 0.72,
) -> list[PhoneFrame]:  # fmt: skip
    """`count` frames of a walk through the room at 60 frames/s; its whole length is `frames`.

    Args:
        count, frames: how many there are, and of how long a loop they are the beginning.
        size, depth_size: (width, height) of the images.
        color_later: colour is taken so many frames later than depth and pose.
        focal: focal length in widths of the image.
    """
    scene, caster = _furnished()
    poses = camera_path(scene, frames, "loop", 0)
    camera = Camera(*size, focal * size[0], focal * size[0], size[0] / 2 + 1.25, size[1] / 2 - 2.5)
    small = camera.resize(*depth_size)
    taken = []
    for i in range(count):
        depth, _ = caster.measure(small, poses[i])
        later = poses[i] if not color_later else _between(poses, i + color_later)
        color = caster.render(camera, later).color
        confidence = np.full(depth.shape, 2, np.uint8)
        confidence[depth > 4] = 1
        confidence[:, :2] = 0
        taken.append(PhoneFrame(7000 + i / 60, color, depth.astype(np.float32), confidence, camera, poses[i]))
    return taken


@cache
def _furnished() -> tuple[Scene, RayCaster]:
    """The room, furnished once."""
    scene = furnished_room(0)
    return scene, RayCaster(scene, 0)


def _between(poses: np.ndarray, at: float) -> np.ndarray:
    """A pose between two frames."""
    low = int(at)
    share, a, b = at - low, poses[low], poses[low + 1]
    T = np.eye(4)
    turn = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).as_rotvec()
    T[:3, :3] = a[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    T[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    return T


def write_stray(folder: Path, frames: Sequence[PhoneFrame], lacking: str = "hidden", rate: int = 60) -> Path:
    """StrayScanner as of 2026: columns of intrinsics and two of empty cells, and rgb.mp4 that plays one frame less.

    `lacking`: "hidden": the first frame lies in the file, before the beginning of its edit list, as the app writes it;
    "first", "last": it is not there (a video that was encoded anew); "none": nothing lacks.
    """
    for name in ("depth", "confidence"):
        (folder / name).mkdir(parents=True)
    first, last = (1 if lacking == "first" else 0), len(frames) - (1 if lacking == "last" else 0)
    height, width = frames[0].color.shape[:2]
    video = cv2.VideoWriter(str(folder / "rgb.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), rate, (width, height))
    for frame in frames[first:last]:
        video.write(cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR))
    video.release()
    if lacking == "hidden":
        hide_first_frame(folder / "rgb.mp4")
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy, distortion_center_x, distortion_center_y"]
    for i, frame in enumerate(frames):
        T, c = frame.T_world_camera, frame.camera
        numbers = (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat(), c.fx, c.fy, c.cx, c.cy)
        lines.append(f"{frame.time!r}, {i:06d}, " + ", ".join(str(np.float32(x)) for x in numbers) + ", , ")
        assert cv2.imwrite(str(folder / "depth" / f"{i:06d}.png"), np.rint(frame.depth * 1000).astype(np.uint16))
        assert cv2.imwrite(str(folder / "confidence" / f"{i:06d}.png"), frame.confidence)
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    c = frames[-1].camera
    (folder / "camera_matrix.csv").write_text(f"{c.fx}, 0.0, {c.cx}\n0.0, {c.fy}, {c.cy}\n0.0, 0.0, 1.0")
    (folder / "imu.csv").write_text("timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n")
    return folder


def hide_first_frame(path: Path) -> None:
    """Lets the edit list of an MP4 begin after the first frame."""
    content = bytearray(path.read_bytes())
    edits, steps = content.index(b"elst"), content.index(b"stts")
    content[edits + 16 : edits + 20] = content[steps + 16 : steps + 20]  # the time of the edit = how long a frame is
    path.write_bytes(content)


def write_scanner_app(folder: Path, frames: Sequence[PhoneFrame], color_every: int = 2) -> Path:
    """3D Scanner App, "All Data" of a scan at low resolution: depth and JSON of every frame, colour of some."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, frame in enumerate(frames):
        c = frame.camera
        pose = frame.T_world_camera @ FLIP_YZ
        entries = {
            "averageAngularVelocity": 0.31, "averageVelocity": 0.12, "cameraGrain": 0.0,
            "cameraPoseARFrame": [float(x) for x in np.float32(pose).ravel()], "exposureDuration": 0.008,
            "frame_index": i, "intrinsics": [c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1], "motionQuality": 1.0,
            "time": frame.time,
        }  # fmt: skip
        (folder / f"frame_{i:05d}.json").write_text(json.dumps(entries, indent=2))
        assert cv2.imwrite(str(folder / f"depth_{i:05d}.png"), np.rint(frame.depth * 1000).astype(np.uint16))
        assert cv2.imwrite(str(folder / f"conf_{i:05d}.png"), frame.confidence)
        if i % color_every == 0:
            color = cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR)
            assert cv2.imwrite(str(folder / f"frame_{i:05d}.jpg"), color, [cv2.IMWRITE_JPEG_QUALITY, 92])
    (folder / "info.json").write_text(json.dumps({"title": "2026_01_13_14_47_59", "device": "iPhone13,3"}))
    (folder / "annotations.json").write_text("{}")
    return folder


def write_record3d_2022(path: Path, frames: Sequence[PhoneFrame]) -> Path:
    """Record3D of 2022: metadata of h, w, fps, K (column by column) and poses alone; portrait images."""
    pack = pytest.importorskip("liblzfse").compress
    c = frames[0].camera
    poses = []
    for frame in frames:
        T = frame.T_world_camera @ FLIP_YZ
        poses.append([*Rotation.from_matrix(T[:3, :3]).as_quat(), *T[:3, 3]])
    metadata = {"h": c.height, "w": c.width, "K": [c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1], "fps": 60, "poses": poses}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("icon", b"")
        archive.writestr("metadata", json.dumps(metadata))
        for i, frame in enumerate(frames):
            color = cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR)
            archive.writestr(f"rgbd/{i}.jpg", cv2.imencode(".jpg", color)[1].tobytes())
            archive.writestr(f"rgbd/{i}.depth", pack(np.float32(frame.depth).tobytes()))
            archive.writestr(f"rgbd/{i}.conf", pack(frame.confidence.tobytes()))
        archive.writestr("sound.m4a", struct.pack(">I", 0))
    return path
