# SPDX-License-Identifier: Apache-2.0
"""Surfaces in one depth image: measured noise, bridged holes, normals.

All is done in inverse depth: a plane's inverse depth is linear in the pixel coordinates, and the noise of stereo and
structured-light cameras, which grows with the square of depth, is the same everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from ggslam.scene.camera import Camera

_REFERENCE_WIDTH = 320
_LEAST_NOISE = 2e-4
"""1/m: an inverse depth known better than this gains nothing."""
_MOST_NOISE = 5e-3
"""1/m: what looks noisier (2 cm at 2 m) is clutter."""
_STEEPEST = 0.02
"""Depth over which a surface may fall off from pixel to pixel, as a share of its depth."""


@dataclass(frozen=True)
class DepthSurface:
    """A depth image prepared for segmentation.

    Attributes:
        valid: bool [H, W], pixels with depth, small holes bridged.
        depth: float32 [H, W], metres, smoothed within surfaces; where not valid: the bridged or an arbitrary value.
        inverse: float32 [H, W], 1 / depth.
        points: float32 [H, W, 3], points in the camera frame.
        normals: float32 [H, W, 3], unit normals towards the camera.
        sigma: float, standard deviation of the noise of inverse depth, 1/m.
        step: pixels over which the normals were taken.
    """

    valid: np.ndarray
    depth: np.ndarray
    inverse: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    sigma: float
    step: int

    def noise(self) -> np.ndarray:
        """Standard deviation of depth, float32 [H, W], metres."""
        return np.float32(self.sigma) * self.depth**2


def unbroken(surface: DepthSurface, axis: int, tolerance: np.ndarray) -> np.ndarray:
    """Whether a pixel and its right (axis 1) or lower (axis 0) neighbour are on one surface: bool [H, W-1] or [H-1, W].

    They are if their depths differ by less than `tolerance` (metres, [H, W]), or if either, continued from the pixel
    beyond it, meets the other: seen at a flat angle, a table top or a floor falls off by centimetres from row to row,
    but straight in inverse depth.
    """
    if axis == 0:
        return unbroken(_with_axes_swapped(surface), 1, tolerance.T).T
    z, inverse = surface.depth, surface.inverse
    step = np.abs(z[:, 1:] - z[:, :-1])
    near = step < tolerance[:, :-1]
    bend = np.abs(inverse[:, 2:] - 2 * inverse[:, 1:-1] + inverse[:, :-2])
    miss = np.full(z.shape, np.inf, np.float32)
    miss[:, 1:-1] = bend
    miss *= z * z
    straight = np.minimum(miss[:, :-1], miss[:, 1:]) < tolerance[:, :-1]
    near |= straight & (step < 4 * tolerance[:, :-1] + _STEEPEST * z[:, :-1])
    return near & surface.valid[:, 1:] & surface.valid[:, :-1]


def _with_axes_swapped(surface: DepthSurface) -> DepthSurface:
    return replace(surface, valid=surface.valid.T, depth=surface.depth.T, inverse=surface.inverse.T)


def surface_of(depth: np.ndarray, camera: Camera, max_depth: float) -> DepthSurface:
    """Prepares a depth image float32 [H, W] (metres, 0 = unknown)."""
    measured = (depth > 0) & (depth <= max_depth)
    bridged = _bridge(np.where(measured, depth, np.float32(0)), max(1, round(camera.width / _REFERENCE_WIDTH)))
    valid = bridged > 0
    inverse: np.ndarray = 1 / np.where(valid, bridged, np.float32(1e3))
    sigma = _noise(inverse, valid)
    scale = camera.width / _REFERENCE_WIDTH
    noisy = sigma > 3 * _LEAST_NOISE
    if noisy:
        diameter = 2 * max(1, round(2 * scale)) + 1
        inverse = np.asarray(cv2.bilateralFilter(inverse, diameter, 4 * sigma, diameter / 2))
    step = max(1, round((3 if noisy else 1) * scale))
    smooth = 1 / np.maximum(inverse, np.float32(1e-3))
    normals = _normals(inverse, camera, step, 8 * sigma)
    return DepthSurface(valid, smooth, inverse, camera.rays() * smooth[..., None], normals, sigma, step)


def _bridge(depth: np.ndarray, passes: int) -> np.ndarray:
    """Fills holes up to four times `passes` pixels wide: by the mean of the neighbours on a surface, by the farthest
    at a jump, since what lacks depth there is the background in the shadow of the sensor's light."""
    out = depth
    for _ in range(2 * passes):
        known = (out > 0).astype(np.float32)
        count = cv2.boxFilter(known, -1, (3, 3), normalize=False)
        total = cv2.boxFilter(out, -1, (3, 3), normalize=False)
        farthest = cv2.dilate(out, np.ones((3, 3), np.uint8))
        mean = total / np.maximum(count, 1)
        value = np.where(farthest - mean < 0.02 * farthest, mean, farthest)
        out = np.where((out <= 0) & (count > 2.5), value, out)
    return out


def _noise(inverse: np.ndarray, valid: np.ndarray) -> float:
    """Standard deviation of inverse depth about its local mean, of the calmer part of the image."""
    inner = cv2.erode(valid.astype(np.uint8), np.ones((3, 3), np.uint8))[::2, ::2] > 0
    away = np.abs(inverse - cv2.blur(inverse, (3, 3)))[::2, ::2][inner]
    if len(away) < 100:
        return _LEAST_NOISE
    # 70 % of a normal distribution lie within 1.04 standard deviations; a median would miss quantised depth.
    return min(max(float(np.quantile(away, 0.7)) / 1.04 * 1.06, _LEAST_NOISE), _MOST_NOISE)


def _normals(inverse: np.ndarray, camera: Camera, step: int, jump: float) -> np.ndarray:
    """Unit normals float32 [H, W, 3] from differences of inverse depth over `step` pixels, on one side only where the
    other is beyond a jump."""
    gx = _slope(inverse, step, jump) * np.float32(camera.fx)
    gy = _slope(inverse.T, step, jump).T * np.float32(camera.fy)
    rays = camera.rays()
    # n . ray = 1/z (times a constant) on a plane, so its gradient holds the first two components.
    normals = np.dstack([gx, gy, inverse - gx * rays[..., 0] - gy * rays[..., 1]])
    normals /= -np.maximum(np.sqrt(np.einsum("ijk,ijk->ij", normals, normals)), 1e-9)[..., None]
    return normals


def _slope(values: np.ndarray, step: int, jump: float) -> np.ndarray:
    """Difference per pixel along the rows of float32 [H, W]."""
    padded = cv2.copyMakeBorder(np.ascontiguousarray(values), 0, 0, step, step, cv2.BORDER_REPLICATE)
    left, right = values - padded[:, : -2 * step], padded[:, 2 * step :] - values
    smaller = np.where(np.abs(left) < np.abs(right), left, right)
    slope = np.where(np.abs(left - right) < jump, (left + right) / 2, smaller)
    slope[:, :step], slope[:, -step:] = right[:, :step], left[:, -step:]
    return slope / np.float32(step)
