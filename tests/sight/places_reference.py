# SPDX-License-Identifier: Apache-2.0
"""What `ggslam.sight.places` finds, slowly, by OpenCV and NumPy."""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, transform_points
from ggslam.sight.margin import Margin
from ggslam.sight.places import CoarseView, PairEvidence, PlaceTuning, thin_out, window_of


def coarse_view(
    depth: np.ndarray, camera: Camera, factor: int, T_world_camera: np.ndarray, margin: Margin
) -> CoarseView:
    """`CoarseView.of`."""
    h, w = camera.height // factor, camera.width // factor
    middle = (factor - 1) / 2
    small = Camera(
        w, h, camera.fx / factor, camera.fy / factor, (camera.cx - middle) / factor, (camera.cy - middle) / factor
    )
    own, around = np.ones((factor, factor), np.uint8), np.ones((3, 3), np.uint8)
    window = window_of(factor)
    near = thin_out(cv2.erode(np.where(depth > 0, depth, np.float32(np.inf)), own), factor)
    far, least = thin_out(cv2.dilate(depth, own), factor), thin_out(cv2.erode(depth, own), factor)
    count, total, squares = (
        thin_out(cv2.boxFilter(image, -1, (window, window), normalize=False), factor)
        for image in ((depth > 0).astype(np.float32), depth, depth * depth)
    )
    mean = total / np.maximum(count, 1)
    spread = squares / np.maximum(count, 1) - mean * mean
    smooth = (count >= PlaceTuning.min_known * window**2) & (
        spread < (PlaceTuning.smooth_sigmas * margin.sigma(mean)) ** 2
    )
    exact = thin_out(depth, factor)
    value = np.where(smooth, mean, exact)
    near, far = np.where(smooth, mean, near), np.where(smooth, mean, far)
    whole = cv2.erode(((least > 0) | smooth).astype(np.uint8), around) > 0
    whole[[0, -1]] = whole[:, [0, -1]] = False  # what is about them is not in the image
    near, far = cv2.erode(near, around), cv2.dilate(far, around)
    return CoarseView(small, np.array(T_world_camera, float), value, near, far, whole, smooth)


def compare_views(view: CoarseView, other: CoarseView, margin: Margin, moved: np.ndarray | None = None) -> PairEvidence:
    """`compare` with one other view."""
    camera = other.camera
    T_other_view = (inverse(other.T_world_camera) @ view.T_world_camera).astype(np.float32)
    points = transform_points(view.camera.back_project(view.depth).reshape(-1, 3), T_other_view)
    z = points[:, 2]
    ahead = np.maximum(z, np.float32(1e-3))
    u = np.float32(camera.fx) * points[:, 0] / ahead + np.float32(camera.cx)
    v = np.float32(camera.fy) * points[:, 1] / ahead + np.float32(camera.cy)
    inside = (view.depth.reshape(-1) > 0) & (z > 1e-3)
    inside &= (u >= -0.5) & (v >= -0.5) & (u < camera.width - 0.5) & (v < camera.height - 0.5)
    column, row = (u + np.float32(0.5)).astype(np.int32), (v + np.float32(0.5)).astype(np.int32)
    where = np.where(inside, row * camera.width + column, 0)
    near, far = other.near.reshape(-1)[where], other.far.reshape(-1)[where]
    known = inside & other.whole.reshape(-1)[where]
    smooth = known & view.smooth.reshape(-1) & other.smooth.reshape(-1)[where]
    told = np.flatnonzero(smooth if moved is None else smooth & ~moved.reshape(-1))[::PlaceTuning.stride]
    share = _measured_share(other, margin, u[told], v[told], z[told])
    slack = margin(z, np.where(smooth, share, PlaceTuning.rough_sigmas).astype(np.float32))
    passed, clearly = known & (near > z + slack), known & (near > z + 2 * slack)
    same = inside & (near < z + slack) & (far > z - slack)
    return PairEvidence(
        *(found.reshape(view.depth.shape) for found in (passed, clearly, clearly & smooth, same, known & ~same))
    )


def _measured_share(other: CoarseView, margin: Margin, u: np.ndarray, v: np.ndarray, z: np.ndarray) -> float:
    """How much depths of smooth places differ."""
    if len(z) < PlaceTuning.min_places:
        return PlaceTuning.rough_sigmas
    left = np.clip(u.astype(np.int32), 0, other.camera.width - 2)
    top = np.clip(v.astype(np.int32), 0, other.camera.height - 2)
    a, b, depth = u - left, v - top, other.depth
    upper = (1 - a) * depth[top, left] + a * depth[top, left + 1]
    lower = (1 - a) * depth[top + 1, left] + a * depth[top + 1, left + 1]
    off = np.abs((1 - b) * upper + b * lower - z) / margin.sigma(z)
    return float(
        np.clip(
            PlaceTuning.nearest_factor * np.median(off) / 0.6745, PlaceTuning.min_noise_share, PlaceTuning.rough_sigmas
        )
    )
