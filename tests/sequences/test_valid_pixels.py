# SPDX-License-Identifier: Apache-2.0
"""What lies beyond the border of an undistorted image is told apart from what a camera saw."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from ggslam.sequences import Sequence, open_sequence


@pytest.fixture
def copy(room: Path, tmp_path: Path) -> Path:
    """Eight frames of the room, with files of their own."""
    folder = tmp_path / "copy"
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
        for path in sorted((room / name).iterdir())[::3]:
            shutil.copy(path, folder / name / path.name)
    shutil.copy(room / "camera.yaml", folder / "camera.yaml")
    return folder


def paint(folder: Path, border: np.ndarray, color: tuple[int, int, int], each: bool = False) -> None:
    """Fills the border of all images, or of each another one."""
    for k, path in enumerate(sorted((folder / "rgb").iterdir())):
        image = cv2.imread(str(path))
        image[np.roll(border, 3 * k, 1) if each else border] = color
        assert cv2.imwrite(str(path), image)


def frame_like(shape: tuple[int, int]) -> np.ndarray:
    """A border as undistortion leaves it: broad at the corners, bent between."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    x, y = (u - shape[1] / 2) / (shape[1] / 2), (v - shape[0] / 2) / (shape[0] / 2)
    return np.maximum(np.abs(x) * (1 + 0.1 * y**2), np.abs(y) * (1 + 0.1 * x**2)) > 1.0


def test_ordinary_recordings_are_valid_all_over(room: Path) -> None:
    sequence = open_sequence(room)
    assert sequence.valid is None and sequence.frame(0).valid is None


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_border_of_a_lens_that_is_undone_here(copy: Path, scale: float) -> None:
    """Pixels whose place in the stored image lies outside it; there depth is none, too."""
    settings = yaml.safe_load((copy / "camera.yaml").read_text())
    (copy / "camera.yaml").write_text(yaml.safe_dump({**settings, "distortion": [0.25, 0.0, 0.0, 0.0, 0.0]}))
    sequence = open_sequence(copy, scale=scale)
    c, k = sequence.camera, 0.25
    assert sequence.valid is not None
    v, u = np.mgrid[: c.height, : c.width]
    x, y = (u - c.cx) / c.fx, (v - c.cy) / c.fy
    r2 = x**2 + y**2
    columns, rows = c.fx * x * (1 + k * r2) + c.cx, c.fy * y * (1 + k * r2) + c.cy
    outside = (columns < -1) | (columns > c.width) | (rows < -1) | (rows > c.height)
    inside = (columns > 1) & (columns < c.width - 2) & (rows > 1) & (rows < c.height - 2)
    assert outside.sum() > 50 and not sequence.valid[outside].any() and sequence.valid[inside].all()
    frame = sequence.frame(0)
    assert frame.valid is sequence.valid and not frame.depth[outside].any()
    assert scale < 1 or not frame.color[outside].any()


@pytest.mark.parametrize("color", [(0, 0, 0), (128, 128, 128), (255, 255, 255)])
def test_border_that_somebody_left(copy: Path, color: tuple[int, int, int]) -> None:
    border = frame_like((120, 160))
    paint(copy, border, color)
    sequence = open_sequence(copy)
    assert sequence.valid is not None
    assert not sequence.valid[border].any()
    beside = cv2.dilate(border.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    assert sequence.valid[beside].all()
    frame = sequence.frame(3)
    assert not frame.depth[border].any() and (frame.depth[beside] > 0).mean() > 0.9
    half = open_sequence(copy, scale=0.5).valid
    assert half is not None and half.shape == (60, 80) and not half[border[::2, ::2] & border[1::2, 1::2]].any()


def test_what_only_looks_like_a_border(copy: Path) -> None:
    """It moves, or nothing else does, or it is only in the first image."""
    border = frame_like((120, 160))
    first = sorted((copy / "rgb").iterdir())[0]
    image = cv2.imread(str(first))
    moved = image.copy()
    moved[border] = 0
    assert cv2.imwrite(str(first), moved)
    assert open_sequence(copy).valid is None
    assert cv2.imwrite(str(first), image)
    wide = np.zeros((120, 160), bool)
    wide[:30, :50] = True
    paint(copy, wide, (0, 0, 0), each=True)
    assert open_sequence(copy).valid is None
    for path in sorted((copy / "rgb").iterdir()):
        assert cv2.imwrite(str(path), moved)  # a camera that stands still
    assert open_sequence(copy).valid is None


def test_slices_and_damaged_images(copy: Path) -> None:
    paint(copy, frame_like((120, 160)), (0, 0, 0))
    images = sorted((copy / "rgb").iterdir())
    images[2].write_bytes(b"")
    sequence = open_sequence(copy, on_bad_frame="skip")
    assert isinstance(sequence[3:], Sequence) and sequence.valid is not None and sequence[3:].valid is sequence.valid
    assert all(frame.valid is sequence.valid for frame in sequence.stream())
