# SPDX-License-Identifier: Apache-2.0
"""Starts for the alignment when constant velocity fails: ORB features matched to earlier frames, with their depth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.tracking.settings import RecoverySettings


@dataclass(frozen=True)
class View:
    """A located frame as the feature matcher needs it.

    Attributes:
        color: uint8 [H, W, 3].
        depth: float32 [H, W], metres.
        T_world_camera: float64 [4, 4].
    """

    color: np.ndarray
    depth: np.ndarray
    T_world_camera: np.ndarray


def feature_starts(
    frame: Frame, camera: Camera, views: list[View], settings: RecoverySettings
) -> list[tuple[str, np.ndarray]]:
    """Poses of `frame` from ORB matches (Rublee et al., ICCV 2011) to earlier views and RANSAC PnP on their depth.

    Returns:
        (what it came from, T_world_camera [4, 4]) for each view with enough inliers, in the order of `views`.
    """
    detector = cv2.ORB.create(nfeatures=settings.features, fastThreshold=7)
    keypoints, descriptors = _features(detector, frame.color)
    starts = []
    for number, view in enumerate(views):
        if descriptors is None:
            break
        T = _relative_pose(detector, keypoints, descriptors, view, camera, settings)
        if T is not None:
            starts.append((f"features of view {number}", T))
    return starts


def _features(detector: cv2.ORB, color: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Pixels [n, 2] and descriptors [n, 32] (None without features)."""
    keypoints, descriptors = detector.detectAndCompute(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), None)
    return np.array([k.pt for k in keypoints], float).reshape(-1, 2), descriptors


def _relative_pose(
    detector: cv2.ORB, pixels: np.ndarray, descriptors: np.ndarray, view: View, camera: Camera,
    settings: RecoverySettings,
) -> np.ndarray | None:  # fmt: skip
    """T_world_camera of the frame from its features and a view's, or None."""
    view_pixels, view_descriptors = _features(detector, view.color)
    if view_descriptors is None:
        return None
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(view_descriptors, descriptors)
    matches = [m for m in matches if m.distance <= settings.max_hamming]
    if len(matches) < settings.min_inliers:
        return None
    at_view = view_pixels[[m.queryIdx for m in matches]]
    at_frame = pixels[[m.trainIdx for m in matches]]
    column, row = np.rint(at_view).astype(int).T
    z = view.depth[np.clip(row, 0, camera.height - 1), np.clip(column, 0, camera.width - 1)]
    known = z > 0
    if known.sum() < settings.min_inliers:
        return None
    x = (at_view[:, 0] - camera.cx) / camera.fx * z
    y = (at_view[:, 1] - camera.cy) / camera.fy * z
    points = np.stack([x, y, z], 1)[known].astype(float)
    cv2.setRNGSeed(0)
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points, at_frame[known], camera.matrix(), None, iterationsCount=300,
        reprojectionError=settings.reprojection * camera.width / 320, confidence=0.999, flags=cv2.SOLVEPNP_EPNP,
    )  # fmt: skip
    if not found or inliers is None or len(inliers) < settings.min_inliers:
        return None
    T_frame_view = np.eye(4)
    T_frame_view[:3, :3] = cv2.Rodrigues(rotation)[0]
    T_frame_view[:3, 3] = translation[:, 0]
    return view.T_world_camera @ inverse(T_frame_view)
