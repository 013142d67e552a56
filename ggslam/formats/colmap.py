# SPDX-License-Identifier: Apache-2.0
"""Sparse models of COLMAP in its binary form: `cameras.bin`, `images.bin`, `points3D.bin`.

Format: "Output Format" in COLMAP's documentation. Little endian. Poses are world to camera (quaternion wxyz,
translation), axes x right, y down, z forward. The centre of the top-left pixel is (0.5, 0.5) there and (0, 0) here.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from ggslam.formats.writer import PosedViews, Takes, Writer
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, matrix_to_quaternion
from ggslam.system.atomic import make_empty_folder, make_folder, write_bytes, write_text
from ggslam.system.plurals import quantity

MODEL = "sparse/0"
_PINHOLE: Final = 1
"""Number of COLMAP's camera model PINHOLE."""
_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track_length", "<u8")])


def write_colmap_model(
    folder: str | Path, cameras: Sequence[Camera], names: Sequence[str], T_world_camera: Sequence[np.ndarray],
    points: np.ndarray, colors: np.ndarray,
) -> None:  # fmt: skip
    """Writes a model of images of pinhole cameras; each file whole or not at all.

    Args:
        folder: exists; customarily `sparse/0`.
        cameras: of each image; equal ones become one, numbered from 1 in the order in which they come.
        names: of the image files, relative to the folder of images; images are numbered from 1 in this order.
        T_world_camera: a float64 [4, 4] for each.
        points: [N, 3] metres; they have no tracks: no image is said to have seen them.
        colors: uint8 [N, 3].

    Raises:
        RunFolderError: a file cannot be written.
    """
    folder = Path(folder)
    numbers = {camera: number for number, camera in enumerate(dict.fromkeys(cameras), start=1)}
    write_bytes(folder / "cameras.bin", _cameras(numbers))
    write_bytes(folder / "images.bin", _images(names, T_world_camera, [numbers[camera] for camera in cameras]))
    write_bytes(folder / "points3D.bin", _points(points, colors))


def _cameras(numbers: Mapping[Camera, int]) -> bytes:
    parts = [struct.pack("<Q", len(numbers))]
    for camera, number in numbers.items():
        values = (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5)
        parts.append(struct.pack("<IiQQ4d", number, _PINHOLE, camera.width, camera.height, *values))
    return b"".join(parts)


def _images(names: Sequence[str], T_world_camera: Sequence[np.ndarray], cameras: Sequence[int]) -> bytes:
    parts = [struct.pack("<Q", len(names))]
    for number, (name, T, camera) in enumerate(zip(names, T_world_camera, cameras, strict=True), start=1):
        T_camera_world = inverse(np.asarray(T, float))
        pose = (*matrix_to_quaternion(T_camera_world[:3, :3]), *T_camera_world[:3, 3])
        parts.append(struct.pack("<I7dI", number, *pose, camera) + name.encode() + b"\0" + struct.pack("<Q", 0))
    return b"".join(parts)


def _points(points: np.ndarray, colors: np.ndarray) -> bytes:
    rows = np.zeros(len(points), _POINT)
    rows["id"] = np.arange(1, len(points) + 1)
    rows["xyz"], rows["rgb"] = points, colors
    rows["error"] = -1  # COLMAP's word for unknown
    return struct.pack("<Q", len(rows)) + rows.tobytes()


def _write(folder: Path, posed: PosedViews) -> str:
    """`images/`, a sparse model `sparse/0/` in COLMAP's binary form and `sparse/0/test.txt`, the images that were held
    out. Images are as the run saw them: undistorted, at its resolution, PNG."""
    make_empty_folder(folder)
    make_folder(folder / MODEL)
    views = posed.save(folder / "images", None)
    write_colmap_model(
        folder / MODEL, [v.camera for v in views], [v.name for v in views], [v.T_world_camera for v in views],
        posed.cloud.points, posed.cloud.colors,
    )  # fmt: skip
    write_text(folder / MODEL / "test.txt", "".join(f"{v.name}\n" for v in views if v.held_out))
    return f"wrote {folder}: {posed.text(views)}, {quantity(len(posed.cloud), 'point')}, COLMAP"


WRITER = Writer("colmap", (), Takes.VIEWS, "images, poses and points, a COLMAP folder", _write)
