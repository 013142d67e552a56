# SPDX-License-Identifier: Apache-2.0
"""`transforms.json` as nerfstudio and its relatives read it.

Format: "Data conventions" in nerfstudio's documentation. Poses are camera to world with OpenGL's camera axes (x right,
y up, z backwards), here x right, y down, z forward; the world's axes stay. The centre of the top-left pixel is
(0.5, 0.5) there and (0, 0) here. Depth images are 16 bit, millimetres, 0 = none.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from ggslam.formats.point_ply import write_metric_points
from ggslam.formats.writer import PosedViews, Takes, Writer
from ggslam.scene.camera import Camera
from ggslam.system.atomic import make_empty_folder, write_text
from ggslam.system.plurals import quantity

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
MOST_DEPTH: Final = 65.535
"""Largest depth in metres that a 16-bit image of millimetres holds; farther pixels have none."""


@dataclass(frozen=True)
class TransformsFrame:
    """One image: its file and its depth's, relative to the folder of transforms.json, T_world_camera float64 [4, 4]
    with the axes of this project, whether it was kept away from training, and its camera."""

    image: str
    depth: str
    T_world_camera: np.ndarray
    held_out: bool
    camera: Camera


def write_transforms(path: str | Path, frames: Sequence[TransformsFrame], points: str | None = None) -> None:
    """Writes the file, whole or not at all. Images of several cameras each tell their own.

    Args:
        path: of transforms.json.
        frames: the images, one or more; those held out are named as validation and test images.
        points: PLY file of coloured points that training may begin with, relative to the folder.

    Raises:
        RunFolderError: it cannot be written.
    """
    held_out = [frame.image for frame in frames if frame.held_out]
    several = len({frame.camera for frame in frames}) > 1
    shared = {} if several else _intrinsics(frames[0].camera)
    values: dict[str, Any] = {"camera_model": "OPENCV", **shared, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    if points is not None:
        values["ply_file_path"] = points
    if held_out:
        trained = [frame.image for frame in frames if not frame.held_out]
        values |= {"train_filenames": trained, "val_filenames": held_out, "test_filenames": held_out}
    values["frames"] = [
        {"file_path": frame.image, "depth_file_path": frame.depth,
         **(_intrinsics(frame.camera) if several else {}),
         "transform_matrix": (np.asarray(frame.T_world_camera, float) @ _OPENGL_FROM_OPENCV).tolist()}
        for frame in frames
    ]  # fmt: skip
    write_text(path, json.dumps(values, indent=1) + "\n")


def _intrinsics(camera: Camera) -> dict[str, float]:
    return {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx + 0.5,
            "cy": camera.cy + 0.5}  # fmt: skip


def millimetres(depth: np.ndarray) -> np.ndarray:
    """A depth image in metres, float [H, W], as uint16 millimetres; 0 where there is none or more than `MOST_DEPTH`."""
    known = (depth > 0) & (depth <= MOST_DEPTH)
    return np.where(known, np.rint(np.where(known, depth, 0) * 1000), 0).astype(np.uint16)


def _write(folder: Path, posed: PosedViews) -> str:
    """`images/`, `depth/` (16 bit, millimetres), `points.ply` and `transforms.json`, which names the images to train
    on and those that were held out."""
    make_empty_folder(folder)
    views = posed.save(folder / "images", folder / "depth")
    write_metric_points(folder / "points.ply", posed.cloud)
    frames = [
        TransformsFrame(f"images/{v.name}", f"depth/{v.name}", v.T_world_camera, v.held_out, v.camera) for v in views
    ]
    write_transforms(folder / "transforms.json", frames, "points.ply")
    return f"wrote {folder}: {posed.text(views)} with depth, {quantity(len(posed.cloud), 'point')}, nerfstudio"


WRITER = Writer("nerfstudio", (), Takes.VIEWS, "images, depth, poses and points, a nerfstudio folder", _write)
