# SPDX-License-Identifier: Apache-2.0
"""Tiny recordings in the true layout of each format. Depth of frame i is 1 + i/10 m, its colour (10 i, 100, 200)."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import yaml

WIDTH, HEIGHT, FRAMES = 32, 24, 5


def pose(i: float) -> np.ndarray:
    """A turned and shifted camera."""
    angle = 0.1 * i
    T = np.eye(4)
    T[:3, :3] = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    T[:3, 3] = (0.1 * i, 0.2, -0.3)
    return T


def write_color(path: Path, i: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.empty((size[1], size[0], 3), np.uint8)
    image[:] = (200, 100, 10 * i)  # OpenCV writes blue first
    assert cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 100])


def write_depth(path: Path, i: int, scale: float, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.full((size[1], size[0]), round((1 + i / 10) * scale), np.uint16)
    image[0, 0] = 0
    assert cv2.imwrite(str(path), image)


def write_mask(path: Path, i: int, size: tuple[int, int] = (WIDTH, HEIGHT), dtype: type = np.uint8) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.zeros((size[1], size[0]), dtype)
    image[:, size[0] // 2 :] = i + 1
    assert cv2.imwrite(str(path), image)


def rows(poses: list[np.ndarray]) -> str:
    return "".join(" ".join(f"{x:.9f}" for x in T.ravel()) + "\n" for T in poses)


def tum_line(time: float, i: float) -> str:
    x, y, z = pose(i)[:3, 3]
    return f"{time:.6f} {x} {y} {z} 0 0 {np.sin(0.05 * i):.9f} {np.cos(0.05 * i):.9f}\n"


def make_replica(folder: Path, suffix: str = "jpg") -> Path:
    for i in range(FRAMES):
        write_color(folder / "results" / f"frame{i:06d}.{suffix}", i)
        write_depth(folder / "results" / f"depth{i:06d}.png", i, 1000)
        write_mask(folder / "semantic_instance" / f"semantic_instance_{i}.png", i, dtype=np.uint16)
    (folder / "traj.txt").write_text(rows([pose(i) for i in range(FRAMES)]))
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 30.0, "fy": 31.0, "cx": 15.0, "cy": 11.0, "scale": 1000.0}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera, "instances": {"1": "floor"}}))
    return folder


def make_tum(folder: Path, offset: float = 0.01) -> Path:
    lists = {"rgb": "# colour\n", "depth": "# depth\n"}
    truth = "# timestamp tx ty tz qx qy qz qw\n"
    for i in range(FRAMES):
        time = 1000 + i / 30
        write_color(folder / "rgb" / f"{time:.6f}.png", i)
        write_depth(folder / "depth" / f"{time + offset:.6f}.png", i, 5000)
        lists["rgb"] += f"{time:.6f} rgb/{time:.6f}.png\n"
        lists["depth"] += f"{time + offset:.6f} depth/{time + offset:.6f}.png\n"
    for k in range(2 * FRAMES):  # at twice the rate, a quarter of a frame early
        truth += tum_line(1000 + (k / 2 - 0.25) / 30, k / 2 - 0.25)
    (folder / "rgb.txt").write_text(lists["rgb"])
    (folder / "depth.txt").write_text(lists["depth"])
    (folder / "groundtruth.txt").write_text(truth)
    return folder


def make_seven_scenes(folder: Path, intrinsics: bool = True) -> Path:
    for i in range(FRAMES):
        write_color(folder / f"frame-{i:06d}.color.png", i)
        write_depth(folder / f"frame-{i:06d}.depth.png", i, 1000)
        write_mask(folder / f"frame-{i:06d}.segm.png", i)
        (folder / f"frame-{i:06d}.pose.txt").write_text("\n".join("\t ".join(f"{x:.9e}" for x in r) for r in pose(i)))
    if intrinsics:
        (folder / "camera-intrinsics.color.txt").write_text("30 0 15\n0 31 11\n0 0 1\n")
    return folder


def make_scannet(folder: Path, root: str = "frames") -> Path:
    base = folder / root
    for i in range(FRAMES):
        number = 8 + i  # natural order: 8, 9, 10, 11, 12
        write_color(base / "color" / f"{number}.jpg", i, (64, 48))
        write_depth(base / "depth" / f"{number}.png", i, 1000)
        write_mask(folder / "instance-filt" / f"{number}.png", i, (64, 48))
        (base / "pose").mkdir(exist_ok=True)
        lost = "-inf -inf -inf -inf\n" * 4
        text = lost if i == 2 else "\n".join(" ".join(f"{x:.6f}" for x in r) for r in pose(i))
        (base / "pose" / f"{number}.txt").write_text(text)
    (base / "intrinsic").mkdir()
    (base / "intrinsic" / "intrinsic_color.txt").write_text("60 0 31 0\n0 60 24 0\n0 0 1 0\n0 0 0 1\n")
    (base / "intrinsic" / "intrinsic_depth.txt").write_text("30 0 15.5 0\n0 30 11.5 0\n0 0 1 0\n0 0 0 1\n")
    return folder


def make_folder(folder: Path) -> Path:
    for i in range(FRAMES):
        write_color(folder / "rgb" / f"{i}.png", i)
        write_depth(folder / "depth" / f"{i}.png", i, 5000)
        write_mask(folder / "masks" / f"{i}.png", i)
    settings = {"width": WIDTH, "height": HEIGHT, "fx": 30, "fy": 31.0, "cx": 15.0, "cy": 11.0, "depth_scale": 5000}
    (folder / "camera.yaml").write_text(yaml.safe_dump({**settings, "instances": {1: "wall"}}))
    (folder / "poses.txt").write_text("".join(tum_line(i / 10, i) for i in range(FRAMES)))
    return folder


MAKERS: dict[str, Callable[[Path], Path]] = {
    "replica": make_replica,
    "tum": lambda folder: make_tum(folder / "rgbd_dataset_freiburg3_test"),
    "7scenes": make_seven_scenes,
    "scannet": make_scannet,
    "folder": make_folder,
}
