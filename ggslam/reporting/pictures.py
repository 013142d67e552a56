# SPDX-License-Identifier: Apache-2.0
"""Pictures of maps and recordings."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from ggslam.errors import RunFolderError
from ggslam.formats.atomic import write_bytes


def color_to_uint8(image: np.ndarray) -> np.ndarray:
    """uint8 [H, W, 3] of a planar float image [3, H, W] in [0, 1], clipped."""
    return (np.clip(image, 0, 1).transpose(1, 2, 0) * 255 + 0.5).astype(np.uint8)


def color_of_depth(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Depth [H, W] in metres as colours, uint8 [H, W, 3]: near is warm, far is cold, none is black."""
    level = np.clip((far - depth) / max(far - near, 1e-6), 0, 1)
    picture = cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1].copy()
    picture[depth <= 0] = 0
    return picture


def depth_range(depth: np.ndarray) -> tuple[float, float]:
    """Nearest and farthest depth worth showing: the 1st and 99th percentile of what is known."""
    seen = depth[depth > 0]
    near, far = np.percentile(seen, [1, 99]) if len(seen) else (0.0, 1.0)
    return float(near), float(far)


def color_of_error(difference: np.ndarray, full_scale: float) -> np.ndarray:
    """Non-negative errors [H, W] as colours, black for none, bright for `full_scale` and more."""
    level = np.clip(difference / full_scale, 0, 1)
    return cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_INFERNO)[..., ::-1].copy()


def side_by_side(pictures: list[np.ndarray], gap: int = 4) -> np.ndarray:
    """Pictures of equal height in a row with white gaps."""
    height = pictures[0].shape[0]
    space = np.full((height, gap, 3), 255, np.uint8)
    row = [part for picture in pictures for part in (picture, space)][:-1]
    return np.concatenate(row, axis=1)


def compare(
    truth: np.ndarray, rendered: np.ndarray, true_depth: np.ndarray, rendered_depth: np.ndarray
) -> np.ndarray:
    """Truth, render and colour error; measured depth, rendered depth and depth error: two rows of three.

    Args:
        truth: uint8 [H, W, 3].
        rendered: uint8 [H, W, 3].
        true_depth, rendered_depth: float [H, W], metres, 0 = none.
    """
    near, far = depth_range(true_depth)
    error = np.abs(truth.astype(np.float32) - rendered.astype(np.float32)).mean(-1) / 255
    depth_error = np.where((true_depth > 0) & (rendered_depth > 0), np.abs(true_depth - rendered_depth), 0)
    upper = side_by_side([truth, rendered, color_of_error(error, 0.2)])
    lower = side_by_side(
        [color_of_depth(true_depth, near, far), color_of_depth(rendered_depth, near, far),
         color_of_error(depth_error, 0.1)]
    )  # fmt: skip
    return np.concatenate([upper, np.full((4, upper.shape[1], 3), 255, np.uint8), lower])


def write_picture(path: Path, picture: np.ndarray) -> None:
    """Writes uint8 [H, W, 3] RGB (or [H, W], 8 or 16 bit) as PNG or JPEG by the name's ending, atomically.

    Raises:
        RunFolderError: the ending is not known, or the file cannot be written.
    """
    if picture.ndim == 3:
        picture = picture[..., ::-1]
    try:
        good, data = cv2.imencode(path.suffix or ".png", picture)
    except cv2.error:
        good = False
    if not good:
        raise RunFolderError(f"{path}: cannot be encoded as an image; use .png or .jpg")
    write_bytes(path, data.tobytes())
