# SPDX-License-Identifier: Apache-2.0
"""Starts for the alignment when constant velocity fails: ORB features matched to earlier frames, with their depth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse
from ggslam.tracking.settings import RecoverySettings


@dataclass(frozen=True)
class Features:
    """ORB features: pixels float64 [n, 2], descriptors uint8 [n, 32]."""

    pixels: np.ndarray
    descriptors: np.ndarray


@dataclass
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
    _features: Features | None = None

    def features(self, settings: RecoverySettings) -> Features:
        """ORB features (Rublee et al., ICCV 2011), found when first asked for."""
        if self._features is None:
            detector = cv2.ORB.create(nfeatures=settings.features, fastThreshold=7)
            keypoints, found = detector.detectAndCompute(cv2.cvtColor(self.color, cv2.COLOR_RGB2GRAY), None)
            descriptors = np.zeros((0, 32), np.uint8) if found is None else found
            self._features = Features(np.array([k.pt for k in keypoints], float).reshape(-1, 2), descriptors)
        return self._features


def feature_starts(
    view: View, camera: Camera, earlier: list[View], settings: RecoverySettings
) -> list[tuple[str, np.ndarray]]:
    """Poses of `view` (whose own pose is not used) from feature matches to earlier views and PnP on their depth.

    Returns:
        (what it came from, T_world_camera [4, 4]) for each earlier view with enough inliers, in their order.
    """
    starts = []
    for number, other in enumerate(earlier):
        T = _pose_from_matches(view.features(settings), other, camera, settings)
        if T is not None:
            starts.append((f"features of view {number}", T))
    return starts


def _pose_from_matches(found: Features, other: View, camera: Camera, settings: RecoverySettings) -> np.ndarray | None:
    """T_world_camera of a frame from its features and a located view's: RANSAC, EPnP, then Levenberg-Marquardt."""
    known = other.features(settings)
    if len(known.pixels) == 0 or len(found.pixels) == 0:
        return None
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(known.descriptors, found.descriptors)
    matches = [m for m in matches if m.distance <= settings.max_hamming]
    pixels = known.pixels[[m.queryIdx for m in matches]].reshape(-1, 2)
    targets = found.pixels[[m.trainIdx for m in matches]].reshape(-1, 2)
    column, row = np.rint(pixels).astype(int).T
    z = other.depth[np.clip(row, 0, camera.height - 1), np.clip(column, 0, camera.width - 1)].astype(float)
    x = (pixels[:, 0] - camera.cx) / camera.fx * z
    y = (pixels[:, 1] - camera.cy) / camera.fy * z
    points, targets = np.stack([x, y, z], 1)[z > 0], targets[z > 0]
    if len(points) < settings.min_inliers:
        return None
    cv2.setRNGSeed(0)
    ok, rotation, translation, inliers = cv2.solvePnPRansac(
        points, targets, camera.matrix(), None, iterationsCount=300,
        reprojectionError=settings.reprojection * camera.width / 320, confidence=0.999, flags=cv2.SOLVEPNP_EPNP,
    )  # fmt: skip
    if not ok or inliers is None or len(inliers) < settings.min_inliers:
        return None
    chosen = inliers[:, 0]
    rotation, translation = cv2.solvePnPRefineLM(
        points[chosen], targets[chosen], camera.matrix(), None, rotation, translation
    )
    T_frame_other = np.eye(4)
    T_frame_other[:3, :3] = cv2.Rodrigues(rotation)[0]
    T_frame_other[:3, 3] = translation[:, 0]
    return other.T_world_camera @ inverse(T_frame_other)
