# SPDX-License-Identifier: Apache-2.0
"""Pictures of maps and recordings."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.linalg import svd

from ggslam.errors import RenderError, RunFolderError
from ggslam.rendering.types import RenderBuffers
from ggslam.system.atomic import write_bytes
from ggslam.system.tuning import Tuning


class IdentityPictureTuning(Tuning):
    """How identity vectors become colours."""

    fitted = 20_000
    """Vectors that principal components are fitted to; at most about twice as many."""


def color_to_uint8(image: np.ndarray) -> np.ndarray:
    """uint8 [H, W, 3] of a planar float image [3, H, W] in [0, 1], clipped."""
    return (np.clip(image, 0, 1).transpose(1, 2, 0) * 255 + 0.5).astype(np.uint8)


def color_of_depth(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Depth [H, W] in metres as colours, uint8 [H, W, 3]: near is warm, far is cold, none is black."""
    if not depth.size:  # OpenCV has no word for it
        return np.zeros((*depth.shape, 3), np.uint8)
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


def color_of_ids(ids: np.ndarray, palette: np.ndarray, outlines: bool = False) -> np.ndarray:
    """Object ids uint16 [H, W] as colours, uint8 [H, W, 3].

    Args:
        ids: the ids.
        palette: uint8 [65536, 3], the colour of each.
        outlines: draw a black line of one pixel where one object meets another.
    """
    picture = palette[ids]
    if outlines:
        square = np.ones((2, 2), np.uint8)
        picture[cv2.erode(ids, square) != cv2.dilate(ids, square)] = 0
    return picture


class IdentityColors:
    """Identity vectors as colours: their first three principal components as red, green and blue. Fitted once, so that
    a vector has the same colour in all pictures.

    Args:
        features: float32 [N, F], identity vectors of Gaussians.
    """

    def __init__(self, features: np.ndarray) -> None:
        sample = features[:: max(1, len(features) // IdentityPictureTuning.fitted)]
        if len(sample) < 3:  # too few to have components
            sample = np.concatenate([sample, np.zeros((3, features.shape[1]), np.float32)])
        self._mean = sample.mean(0)
        axes = svd(sample - self._mean, full_matrices=False)[2]
        axes = axes * np.sign(axes[np.arange(len(axes)), np.abs(axes).argmax(1)])[:, None]  # signs are free
        self._axes = axes[: min(3, *sample.shape)]
        self._low, self._high = np.percentile(self._components(sample), [1, 99], axis=0)

    def _components(self, vectors: np.ndarray) -> np.ndarray:
        """Principal components [M, 3] of vectors [M, F]."""
        return vectors @ self._axes.T - self._mean[None] @ self._axes.T

    def picture(self, features: np.ndarray, alpha: np.ndarray, min_alpha: float = 0.5) -> np.ndarray:
        """Colours uint8 [H, W, 3] of a rendered identity image [F, H, W]; black where alpha [H, W] is too low."""
        vectors = (features / np.maximum(alpha, 1e-3)).reshape(len(features), -1).T
        level = (self._components(vectors) - self._low) / np.maximum(self._high - self._low, 1e-6)
        picture = np.zeros((*alpha.shape, 3), np.uint8)
        values = (255 * np.clip(level, 0, 1) + 0.5).astype(np.uint8).reshape(*alpha.shape, -1)
        picture[..., : values.shape[2]] = values
        picture[alpha < min_alpha] = 0
        return picture


def legend(entries: list[tuple[str, tuple[int, int, int]]], rows: int = 24) -> np.ndarray:
    """A picture, uint8 [H, W, 3], of names beside their colours, in columns of `rows`. Letters that are not ASCII
    become question marks."""
    height, width, box = 22, 280, 14
    columns = max(1, -(-len(entries) // rows))
    picture = np.full((height * max(1, min(len(entries), rows)), width * columns, 3), 255, np.uint8)
    for number, (text, color) in enumerate(entries):
        x, y = width * (number // rows) + 6, height * (number % rows) + 4
        cv2.rectangle(picture, (x, y), (x + box, y + box), color, cv2.FILLED)
        shown = text.encode("ascii", "replace").decode()[:32]
        place = (x + box + 8, y + 12)
        cv2.putText(picture, shown, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return picture


def side_by_side(pictures: list[np.ndarray], gap: int = 4) -> np.ndarray:
    """Pictures of equal height in a row with white gaps."""
    height = pictures[0].shape[0]
    space = np.full((height, gap, 3), 255, np.uint8)
    row = [part for picture in pictures for part in (picture, space)][:-1]
    return np.concatenate(row, axis=1)


def compare_pictures(
    truth: np.ndarray,
    rendered: np.ndarray,
    true_depth: np.ndarray,
    rendered_depth: np.ndarray,
    more: list[np.ndarray] | None = None,
) -> np.ndarray:
    """Truth, render and colour error; measured depth, rendered depth and depth error: two rows of three.

    Args:
        truth: uint8 [H, W, 3].
        rendered: uint8 [H, W, 3].
        true_depth, rendered_depth: float [H, W], metres, 0 = none.
        more: three pictures uint8 [H, W, 3] for a third row.
    """
    near, far = depth_range(true_depth)
    error = np.abs(truth.astype(np.float32) - rendered.astype(np.float32)).mean(-1) / 255
    depth_error = np.where((true_depth > 0) & (rendered_depth > 0), np.abs(true_depth - rendered_depth), 0)
    upper = side_by_side([truth, rendered, color_of_error(error, 0.2)])
    lower = side_by_side(
        [color_of_depth(true_depth, near, far), color_of_depth(rendered_depth, near, far),
         color_of_error(depth_error, 0.1)]
    )  # fmt: skip
    gap = np.full((4, upper.shape[1], 3), 255, np.uint8)
    third = [] if more is None else [gap, side_by_side(more)]
    return np.concatenate([upper, gap, lower, *third])


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


def identity_picture(view: RenderBuffers, colors: IdentityColors) -> np.ndarray:
    """The rendered identity vectors as colours, uint8 [H, W, 3]."""
    if view.features is None:
        raise RenderError("the view was rendered without features")
    return colors.picture(view.features.numpy(), view.alpha.numpy())
