# SPDX-License-Identifier: Apache-2.0
"""Locates a camera by colour: aligns its image to the map as rendered from nearby.

Depth whose errors are shared by neighbouring pixels pulls a pose along with them, however many points there are. The
map is the mean over many frames, and a picture of it fits a camera's image to a tenth of a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from ggslam.mapping.settings import ViewAlignmentSettings
from ggslam.scene.camera import Camera
from ggslam.scene.poses import se3_exp, se3_log, transform_points
from ggslam.system.tuning import Tuning


class AlignmentTuning(Tuning):
    """Alignment of an image to the rendered map."""

    blurs = (2.0, 1.0)
    """Standard deviations of the smoothing, in pixels, one pass each: the first has the larger basin."""
    min_points = 500
    """Fewest textured pixels of an alignment."""
    huber = 0.05
    """Grey difference, in [0, 1], from which a residual counts linearly."""
    pixels_alike = 30.0
    """Residuals that count as one where the image is weighed against the pose that it starts from: what the map draws
    wrongly, many neighbours share."""


_GREY = np.array([0.299, 0.587, 0.114], np.float32)
_MEDIAN_OF_NORMAL: Final = 0.6745
"""Median of the absolute value of a standard normal variable."""
_CHUNK: Final = 1024  # columns of the images that cv2.remap is asked for: it takes no more than 32767
"""Columns per row that cv2.remap is called with. It takes no more than 32767."""


@dataclass(frozen=True)
class PosePrior:
    """How well the pose is known that an alignment starts from.

    Attributes:
        translation: standard deviation, metres.
        rotation: standard deviation, radians.
    """

    translation: float
    rotation: float

    @property
    def information(self) -> np.ndarray:
        """Inverse variances of a twist [6], translation first."""
        return 1 / np.square([self.translation] * 3 + [self.rotation] * 3)


def grey_of(color: np.ndarray) -> np.ndarray:
    """Grey values in [0, 1], float32 [H, W], of colours uint8 or float32 in [0, 1], [H, W, 3]."""
    scale = np.float32(1 / 255 if color.dtype == np.uint8 else 1)
    return color.astype(np.float32) @ _GREY * scale


def align_view(
    grey: np.ndarray, rendered: np.ndarray, depth: np.ndarray, alpha: np.ndarray, camera: Camera,
    settings: ViewAlignmentSettings, blurs: Sequence[float] = AlignmentTuning.blurs, prior: PosePrior | None = None,
) -> np.ndarray | None:  # fmt: skip
    """How the camera that saw an image stands to the pose that a map was rendered from.

    Gauss-Newton over pose, gain and offset of the grey values, with Huber weights (direct image alignment). The points
    are those of the rendering, so that the image's own depth plays no part.

    Args:
        grey: of the image, float32 [H, W] in [0, 1].
        rendered: grey values of the map, the same.
        depth: of the map [H, W], metres.
        alpha: of the map [H, W].
        camera: of both.
        settings: number of points and iterations.
        blurs: standard deviations in pixels of the smoothing, one after the other.
        prior: how well the pose of the rendering is known; None: not at all. A camera that moves aside and turns back
            changes its image little: there another sensor's word counts.

    Returns:
        T_camera_rendered [4, 4], None if too little texture is seen or the solution leaves the image.
    """
    T, exposure = np.eye(4), np.array([1.0, 0.0])
    for blur in blurs:
        ours, theirs = (cv2.GaussianBlur(image, (0, 0), blur) for image in (grey, rendered))
        pixels = _choose_textured(theirs, depth, alpha, settings)
        if len(pixels) < AlignmentTuning.min_points:
            return None
        points = camera.rays().reshape(-1, 3)[pixels].astype(np.float64) * depth.reshape(-1)[pixels, None]
        channels = np.dstack([ours, *_gradients(ours)])
        values = theirs.reshape(-1)[pixels]
        for _ in range(settings.iterations):
            step = _step(points, values, channels, camera, T, exposure, prior)
            if step is None:
                return None
            T, exposure = se3_exp(step[:6]) @ T, exposure + step[6:]
            if np.abs(step[:6]).max() < settings.tolerance:
                break
    return T


def misfit(
    grey: np.ndarray, rendered: np.ndarray, depth: np.ndarray, alpha: np.ndarray, camera: Camera,
    settings: ViewAlignmentSettings, T: np.ndarray,
) -> float:  # fmt: skip
    """How badly the map fits an image seen from a pose: mean absolute grey difference of textured pixels, after the
    best gain and offset; NaN if too few are seen.

    Args:
        grey, rendered, depth, alpha, camera, settings: as of `align_view`.
        T: T_camera_rendered [4, 4].
    """
    ours, theirs = (cv2.GaussianBlur(image, (0, 0), AlignmentTuning.blurs[-1]) for image in (grey, rendered))
    pixels = _choose_textured(theirs, depth, alpha, settings)
    points = camera.rays().reshape(-1, 3)[pixels].astype(np.float64) * depth.reshape(-1)[pixels, None]
    u, v, inside = _project(transform_points(points, T), camera)
    if inside.sum() < AlignmentTuning.min_points:
        return float("nan")
    seen = _sample(np.ascontiguousarray(ours[..., None]), u[inside], v[inside])[0]
    values = theirs.reshape(-1)[pixels[inside]].astype(np.float64)
    shown = np.column_stack([values, np.ones(len(values))])
    return float(np.abs(seen - shown @ np.linalg.lstsq(shown, seen, rcond=None)[0]).mean())


def _project(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns and rows [n] of points [n, 3] in a camera's image, and which of them are in it, bool [n]."""
    z = np.maximum(points[:, 2], 0.05)
    u, v = camera.fx * points[:, 0] / z + camera.cx, camera.fy * points[:, 1] / z + camera.cy
    return u, v, (u > 1) & (v > 1) & (u < camera.width - 2) & (v < camera.height - 2)


def _gradients(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives by column and row."""
    return tuple(cv2.Sobel(image, cv2.CV_32F, *d, ksize=3, scale=1 / 8) for d in ((1, 0), (0, 1)))  # type: ignore[return-value]


def _choose_textured(
    rendered: np.ndarray, depth: np.ndarray, alpha: np.ndarray, settings: ViewAlignmentSettings
) -> np.ndarray:
    """Flat indices of pixels that the map covers and that have contrast, evenly thinned to the number set."""
    du, dv = _gradients(rendered)
    good = (alpha > 0.9) & (depth > 0.05) & (du * du + dv * dv > settings.min_gradient**2)
    pixels = np.flatnonzero(good)
    if len(pixels) <= settings.points:
        return pixels
    return pixels[np.linspace(0, len(pixels) - 1, settings.points).astype(np.int64)]


def _step(
    points: np.ndarray, values: np.ndarray, channels: np.ndarray, camera: Camera, T: np.ndarray, exposure: np.ndarray,
    prior: PosePrior | None = None,
) -> np.ndarray | None:
    """A step of Gauss-Newton: twist (translation first) and change of gain and offset, [8]; None: nothing is seen."""
    moved = transform_points(points, T)
    u, v, inside = _project(moved, camera)
    if inside.sum() < AlignmentTuning.min_points:
        return None
    z = np.maximum(moved[:, 2], 0.05)
    grey, du, dv = _sample(channels, u, v)
    residual = grey - (exposure[0] * values + exposure[1])
    weight = np.where(inside, np.minimum(1, AlignmentTuning.huber / np.maximum(np.abs(residual), 1e-6)), 0)
    gx, gy = du * camera.fx / z, dv * camera.fy / z
    by_point = np.stack([gx, gy, -(gx * moved[:, 0] + gy * moved[:, 1]) / z], 1)
    jacobian = np.column_stack([by_point, np.cross(moved, by_point), -values, -np.ones(len(values))])
    weighted = jacobian * weight[:, None]
    hessian = jacobian.T @ weighted + np.diag([1e-6] * 6 + [1e-3] * 2)
    gradient = weighted.T @ residual
    if prior is not None:
        variance = (np.median(np.abs(residual[inside])) / _MEDIAN_OF_NORMAL) ** 2
        strength = AlignmentTuning.pixels_alike * variance * prior.information
        hessian[range(6), range(6)] += strength
        gradient[:6] += strength * se3_log(T)
    step = np.linalg.solve(hessian, -gradient)
    return step if np.isfinite(step).all() else None


def _sample(channels: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Bilinear samples [3, n] of an image [H, W, 3]."""
    padding = (0, -len(u) % _CHUNK)
    columns, rows = (np.pad(x.astype(np.float32), padding).reshape(-1, _CHUNK) for x in (u, v))
    found = cv2.remap(channels, columns, rows, cv2.INTER_LINEAR)
    return found.reshape(-1, channels.shape[2])[: len(u)].T.astype(np.float64)
