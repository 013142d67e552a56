# SPDX-License-Identifier: Apache-2.0
"""The folder layouts that generated recordings are written in: plain, or as Replica's recordings are."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import yaml

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.poses import matrix_to_quaternion
from ggslam.synthetic.raycast import RayImages
from ggslam.system.tuning import Tuning


class LayoutTuning(Tuning):
    """What files of the layouts are like."""

    jpeg_quality = 95
    """Of colour images in Replica's layout."""
    png_level = 3
    """Compression of PNG files."""


class Layout(Protocol):
    """How a recording lies in its folder.

    Attributes:
        name: as asked for.
        file: that tells who made the recording.
        focal: focal length as a share of the image's width.
        depth_scale: units of depth images per metre.
    """

    name: str
    file: str
    focal: float
    depth_scale: float

    def make_folders(self, folder: Path) -> None:
        """Makes the folders of images."""

    def write_images(self, folder: Path, number: int, images: RayImages) -> None:
        """Writes the images of a frame."""

    def write_description(
        self, folder: Path, facts: dict[str, Any], camera: Camera, poses: np.ndarray, times: Sequence[float]
    ) -> None:
        """Writes calibration and poses T_world_camera [n, 4, 4]; `facts` tell how the recording was made."""


class PlainLayout:
    """rgb/, depth/, masks/, camera.yaml and poses.txt."""

    name, file, focal = "plain", "camera.yaml", 0.75
    depth_scale = 5000.0
    """As in TUM recordings."""

    def make_folders(self, folder: Path) -> None:
        for name in ("rgb", "depth", "masks"):
            (folder / name).mkdir()

    def write_images(self, folder: Path, number: int, images: RayImages) -> None:
        file = f"{number:06d}.png"
        write_image(folder / "rgb" / file, cv2.cvtColor(images.color, cv2.COLOR_RGB2BGR))
        write_image(folder / "depth" / file, depth_units(images.depth, self.depth_scale))
        write_image(folder / "masks" / file, images.mask)

    def write_description(
        self, folder: Path, facts: dict[str, Any], camera: Camera, poses: np.ndarray, times: Sequence[float]
    ) -> None:
        description = {
            "width": camera.width, "height": camera.height,
            "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
            "depth_scale": self.depth_scale, **facts,
        }  # fmt: skip
        (folder / self.file).write_text(yaml.safe_dump(description, sort_keys=False), encoding="utf-8")
        lines = ["# timestamp tx ty tz qx qy qz qw (camera to world)"]
        for time, T in zip(times, poses, strict=True):
            w, x, y, z = matrix_to_quaternion(T[:3, :3])
            numbers = (*T[:3, 3], x, y, z, w)
            lines.append(f"{time:.6f} " + " ".join(f"{value:.9f}" for value in numbers))
        (folder / "poses.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


class ReplicaLayout:
    """Replica as rendered for NICE-SLAM: results/frame000000.jpg and depth000000.png, traj.txt, cam_params.json; masks
    in semantic_instance/."""

    name, file, focal, depth_scale = "replica", "cam_params.json", 0.5, 6553.5

    def make_folders(self, folder: Path) -> None:
        for name in ("results", "semantic_instance"):
            (folder / name).mkdir()

    def write_images(self, folder: Path, number: int, images: RayImages) -> None:
        color = cv2.cvtColor(images.color, cv2.COLOR_RGB2BGR)
        write_image(folder / "results" / f"frame{number:06d}.jpg", color)
        depth = depth_units(images.depth, self.depth_scale)
        write_image(folder / "results" / f"depth{number:06d}.png", depth)
        write_image(folder / "semantic_instance" / f"semantic_instance_{number}.png", images.mask)

    def write_description(
        self, folder: Path, facts: dict[str, Any], camera: Camera, poses: np.ndarray, times: Sequence[float]
    ) -> None:
        values = {
            "w": camera.width, "h": camera.height, "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
            "scale": self.depth_scale,
        }  # fmt: skip
        text = json.dumps({"camera": values, **facts}, indent=1)
        (folder / self.file).write_text(text + "\n", encoding="utf-8")
        rows = [" ".join(f"{value:.12g}" for value in T.reshape(-1)) for T in poses]
        (folder / "traj.txt").write_text("\n".join(rows) + "\n", encoding="utf-8")


PLAIN = PlainLayout()
LAYOUTS: dict[str, Layout] = {layout.name: layout for layout in (PLAIN, ReplicaLayout())}


def layout_named(name: str) -> Layout:
    """The layout of that name.

    Raises:
        SequenceError: there is none.
    """
    if name not in LAYOUTS:
        raise SequenceError(f"layout: expected one of {', '.join(LAYOUTS)}, found '{name}'")
    return LAYOUTS[name]


def depth_units(depth: np.ndarray, scale: float) -> np.ndarray:
    """Depth [H, W] metres as the numbers that are stored, uint16 [H, W]; 0, none, where they do not reach."""
    units = np.rint(depth * scale)
    return np.where(units <= np.iinfo(np.uint16).max, units, 0).astype(np.uint16)


def write_image(path: Path, image: np.ndarray) -> None:
    """Writes an image as PNG or JPEG, by the ending of its name; colours are in OpenCV's order.

    Raises:
        SequenceError: it cannot be encoded.
    """
    jpeg = path.suffix == ".jpg"
    options = [cv2.IMWRITE_JPEG_QUALITY, LayoutTuning.jpeg_quality] if jpeg else \
        [cv2.IMWRITE_PNG_COMPRESSION, LayoutTuning.png_level]  # fmt: skip
    done, content = cv2.imencode(path.suffix, image, options)
    if not done:
        raise SequenceError(f"{path}: image cannot be encoded")
    path.write_bytes(content.tobytes())
