# SPDX-License-Identifier: Apache-2.0
"""Surfaces in one depth image: measured noise, bridged holes, normals.

All is done in inverse depth: a plane's inverse depth is linear in the pixel coordinates, and the noise of stereo and
structured-light cameras, which grows with the square of depth, is the same everywhere.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.abi import core
from ggslam.abi.arrays import address
from ggslam.native.loader import load_library
from ggslam.objects.settings import REFERENCE_WIDTH
from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning


class DepthNoiseTuning(Tuning):
    """Bounds of the measured noise of inverse depth."""

    min_noise = 2e-4
    """Smallest noise, in 1/m: better depth gains nothing."""
    max_noise = 5e-3
    """Largest noise, in 1/m: what looks noisier (2 cm at 2 m) is clutter."""


@dataclass(frozen=True)
class DepthSurface:
    """What a depth image shows; arrays are contiguous.

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


def surface_of(depth: np.ndarray, camera: Camera, max_depth: float) -> DepthSurface:
    """Prepares a depth image [H, W] (metres, 0 = unknown)."""
    depth = np.asarray(depth, np.float32)
    measured = (depth > 0) & (depth <= max_depth)
    bridged = _bridge(np.where(measured, depth, np.float32(0)), max(1, round(camera.width / REFERENCE_WIDTH)))
    valid = bridged > 0
    inverse: np.ndarray = 1 / np.where(valid, bridged, np.float32(1e3))
    sigma = _noise(inverse, valid)
    scale = camera.width / REFERENCE_WIDTH
    noisy = sigma > 3 * DepthNoiseTuning.min_noise
    if noisy:
        diameter = 2 * max(1, round(2 * scale)) + 1
        inverse = np.asarray(cv2.bilateralFilter(inverse, diameter, 4 * sigma, diameter / 2))
    step = max(1, round((3 if noisy else 1) * scale))
    smooth = 1 / np.maximum(inverse, np.float32(1e-3))
    normals = normals_of_inverse(inverse, camera, step, 8 * sigma)
    return DepthSurface(valid, smooth, inverse, camera.rays() * smooth[..., None], normals, sigma, step)


def normals_of_inverse(inverse: np.ndarray, camera: Camera, step: int, jump: float) -> np.ndarray:
    """Unit normals towards the camera, float32 [H, W, 3], from differences of inverse depth (float32 [H, W], 1/m) over
    `step` pixels, on one side only where the other is beyond a jump (1/m)."""
    inverse, rays = np.ascontiguousarray(inverse, np.float32), np.ascontiguousarray(camera.rays(), np.float32)
    normals = np.empty((*inverse.shape, 3), np.float32)
    job = core.NormalsJob(
        address(inverse), address(rays), *inverse.shape, step, camera.fx, camera.fy, jump, address(normals)
    )
    load_library().ggslam_surface_normals(ctypes.byref(job))
    return normals


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
        return DepthNoiseTuning.min_noise
    # 70 % of a normal distribution lie within 1.04 standard deviations; a median would miss quantised depth.
    return min(max(float(np.quantile(away, 0.7)) / 1.04 * 1.06, DepthNoiseTuning.min_noise), DepthNoiseTuning.max_noise)
