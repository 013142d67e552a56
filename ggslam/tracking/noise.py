# SPDX-License-Identifier: Apache-2.0
"""Measures the noise of a depth camera on one frame."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.optimize import nnls

from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning
from ggslam.tracking.settings import DepthNoise


class NoiseTuning(Tuning):
    """Measurement of depth noise on one frame."""

    window = 5
    """Side of a window in pixels."""
    min_windows = 60
    """Fewest windows of a range of depth in which noise is measured."""
    min_constant_m = 2e-4
    """Smallest constant noise in metres. Rounding to millimetres alone gives 3e-4."""
    bins_m = np.array([0.3, 0.45, 0.6, 0.8, 1.0, 1.25, 1.5, 1.8, 2.1, 2.5, 3.0, 3.5, 4.0, 5.0, 6.5, 8.0])
    """Limits of the ranges of depth, in metres, in which noise is measured."""


def estimate_noise(depth: np.ndarray, camera: Camera) -> DepthNoise | None:
    """Noise model of the camera from one depth image, or None if too little of it is smooth.

    Planes are fitted to 5x5 windows; the spread about them along the ray, its median per range of depth, is fitted
    by constant + square z^2 with neither negative. Noise that neighbouring pixels share is not seen: take the result
    for how noise changes with depth and between cameras rather than for its absolute size.

    Args:
        depth: float32 [H, W], metres, 0 where unknown.
        camera: its intrinsics.
    """
    z, sigma = _window_spread(depth, camera)
    rows, values = [], []
    for low, high in zip(NoiseTuning.bins_m[:-1], NoiseTuning.bins_m[1:], strict=True):
        inside = (z >= low) & (z < high)
        if inside.sum() >= NoiseTuning.min_windows:
            rows.append([1.0, float(np.median(z[inside])) ** 2])
            values.append(max(float(np.median(sigma[inside])), NoiseTuning.min_constant_m))
    if not rows:
        return None
    if len(rows) == 1:
        return DepthNoise(values[0], 0.0)
    A, b = np.array(rows), np.array(values)
    # Relative residuals: the near range, where noise is small, matters as much as the far one.
    (constant, square), _ = nnls(A / b[:, None], np.ones(len(b)))
    return DepthNoise(max(float(constant), NoiseTuning.min_constant_m), float(square))


def _window_spread(depth: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Depths [n] of smooth 5x5 windows and the standard deviations [n] of depth about their planes, metres."""
    step = max(3, round(camera.width / 100))
    side = NoiseTuning.window
    points = sliding_window_view(camera.back_project(depth), (side, side), axis=(0, 1))[::step, ::step]  # type: ignore[call-overload]
    windows = points.reshape(-1, 3, side**2).astype(np.float64)
    ranges = windows[:, 2]
    middle = ranges[:, side**2 // 2]
    smooth = (ranges > 0).all(1) & (np.ptp(ranges, axis=1) < 0.1 * middle)
    windows, middle = windows[smooth], middle[smooth]
    centre = windows.mean(2)
    centred = windows - centre[:, :, None]
    values, axes = np.linalg.eigh(centred @ centred.transpose(0, 2, 1))
    # An error e of the depth moves a point along its ray by e (x/z, y/z, 1), of which the plane's normal sees this:
    along = np.abs((axes[:, :, 0] * centre).sum(1)) / centre[:, 2]
    return middle, np.sqrt(np.maximum(values[:, 0], 0) / (side**2 - 3)) / np.maximum(along, 0.2)
