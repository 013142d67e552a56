# SPDX-License-Identifier: Apache-2.0
"""A structured-light depth camera: what it does to perfect depth."""

from __future__ import annotations

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning


class SensorTuning(Tuning):
    """What the depth sensor measures."""

    max_depth_m = 8.0
    """Largest depth, in metres."""
    disparity_step = 0.00287
    """Step of depth per squared metre of depth: disparity in eighths of a pixel, focal length 580 px, baseline 7.5
    cm."""
    waves = 3
    """Half waves of the distortion across the image, plus one."""


def disparity_distortion(camera: Camera, rms: float, seed: int) -> np.ndarray:
    """What one camera measures wrongly, always in the same way: an offset of its disparity, float64 [H, W] in steps.

    Smooth over the image, without a mean; makes planes bulge by about rms DISPARITY_STEP z^2 metres (0.3: 3 mm at 2 m,
    8 mm at 3 m, 14 mm at 4 m). Structured-light cameras show such errors (J. Smisek, M. Jancosek and T. Pajdla, "3D
    with Kinect", 2011); D. Herrera C., J. Kannala and J. Heikkila, "Joint Depth and Color Camera Calibration with
    Distortion Correction", PAMI 2012, model them as an offset of the disparity for each pixel. Unlike noise they do not
    average out: odometry drifts. The size is a choice, not a measurement of one camera.

    Args:
        camera: for the size of the image; the pattern is the same at every size.
        rms: root mean square of the offset, steps.
        seed: of the pattern.
    """
    rng = np.random.default_rng([seed, 7])
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    v, u = v / camera.height, u / camera.width
    pattern = np.zeros(v.shape)
    for i in range(SensorTuning.waves):
        for j in range(SensorTuning.waves):
            strength, shift, other = rng.standard_normal(), rng.uniform(0, 2), rng.uniform(0, 2)
            if i + j:
                pattern += strength / np.hypot(i, j) * np.cos(np.pi * (i * v + shift)) * np.cos(np.pi * (j * u + other))
    pattern -= pattern.mean()
    return pattern * (rms / np.sqrt((pattern**2).mean()))


def noisy_depth(
    depth: np.ndarray, camera: Camera, rng: np.random.Generator, distortion: np.ndarray | float = 0.0
) -> np.ndarray:
    """Depth float32 [H, W] as a Kinect would measure it, 0 where it measures nothing.

    Axial noise sigma = 0.0012 + 0.0019 (z - 0.4)^2 (Nguyen, Izadi and Lovell, 2012), disparity in whole steps, holes at
    grazing surfaces and beside depth edges. `distortion` [H, W] is added to the disparity, in steps.
    """
    z = depth.astype(np.float64)
    noisy = z + rng.standard_normal(z.shape) * (0.0012 + 0.0019 * (z - 0.4) ** 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        disparity = np.rint(1 / (noisy * SensorTuning.disparity_step) + distortion)
        noisy = np.where(disparity > 0, 1 / (disparity * SensorTuning.disparity_step), 0)
    chance = rng.random(z.shape)
    edge, cosine = _edges(z), _cosine(z, camera)
    lost = (edge & (chance < 0.75)) | (chance < np.clip((0.22 - cosine) / 0.15, 0, 1)) | (chance < 0.001)
    noisy[lost | (z <= 0.3) | (z > SensorTuning.max_depth_m)] = 0
    return noisy.astype(np.float32)


def noisy_color(color: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Colour uint8 [H, W, 3] with a little sensor noise (1 grey level)."""
    return np.clip(np.rint(color + rng.standard_normal(color.shape, np.float32)), 0, 255).astype(np.uint8)


def _edges(z: np.ndarray) -> np.ndarray:
    """Pixels beside a jump of more than 4 % in depth."""
    edge = np.zeros(z.shape, bool)
    for axis in (0, 1):
        near = [slice(None)] * 2
        far = [slice(None)] * 2
        near[axis], far[axis] = slice(None, -1), slice(1, None)
        a, b = z[tuple(near)], z[tuple(far)]
        jump = np.abs(a - b) > 0.04 * np.minimum(a, b)
        edge[tuple(near)] |= jump
        edge[tuple(far)] |= jump
    return edge


def _cosine(z: np.ndarray, camera: Camera) -> np.ndarray:
    """Cosine between the viewing ray and the surface normal, from the slope of the depth."""
    points = camera.back_project(z.astype(np.float32)).astype(np.float64)
    normal = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    length = np.linalg.norm(normal, axis=-1) * np.linalg.norm(points, axis=-1)
    return np.abs((normal * points).sum(-1)) / np.maximum(length, 1e-12)
