# SPDX-License-Identifier: Apache-2.0
"""Views with ORB features (Rublee et al., ICCV 2011), and the pose of one from another by matches and depth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse
from ggslam.system.array_forms import ColorImage, DepthImage, Form, Points32, Pose
from ggslam.system.savable import savable
from ggslam.system.settings import setting, tuning_class


@tuning_class(frozen=True)
class FeatureSettings:
    """ORB features and the poses from their matches."""

    count: int = setting(1000, 1, 10**5)
    """Maximum number of features of a view."""
    max_hamming: int = setting(64, 0, 256, "bits")
    """Largest distance of two matching descriptors, of 256 bits."""
    reprojection: float = setting(2.0, 0.01, 1e3, "px")
    """Inlier distance of RANSAC in a 320-pixel-wide image."""
    min_inliers: int = setting(12, 6, 10**5)
    """Matches that must agree on a pose."""

    def limit(self, camera: Camera) -> float:
        """`reprojection` in pixels of a camera's images."""
        return self.reprojection * camera.width / 320


@dataclass(frozen=True)
class Features:
    """ORB features: pixels float64 [n, 2], descriptors uint8 [n, 32]."""

    pixels: np.ndarray
    descriptors: np.ndarray


@savable()
@dataclass(frozen=True)
class Landmarks:
    """Features with depth: all of a view that it takes to find a pose relative to it, without its images.

    Attributes:
        descriptors: uint8 [n, 32].
        points: float32 [n, 3], in the view's camera frame, metres.
    """

    descriptors: Annotated[np.ndarray, Form("u1", "n", 32)]
    points: Points32

    def __len__(self) -> int:
        return len(self.points)


@savable(not_saved="_features")
@dataclass
class FeatureView:
    """A frame as the feature matcher needs it.

    Attributes:
        color: uint8 [H, W, 3].
        depth: float32 [H, W], metres.
        T_world_camera: float64 [4, 4].
    """

    color: ColorImage
    depth: DepthImage
    T_world_camera: Pose
    _features: Features | None = None

    def features(self, settings: FeatureSettings) -> Features:
        """ORB features, found when first asked for."""
        if self._features is None:
            detector = cv2.ORB.create(nfeatures=settings.count, fastThreshold=7)
            keypoints, found = detector.detectAndCompute(cv2.cvtColor(self.color, cv2.COLOR_RGB2GRAY), None)
            descriptors = np.zeros((0, 32), np.uint8) if found is None else found
            self._features = Features(np.array([k.pt for k in keypoints], float).reshape(-1, 2), descriptors)
        return self._features

    def landmarks(self, camera: Camera, settings: FeatureSettings) -> Landmarks:
        """The features that have depth at their nearest pixel."""
        features = self.features(settings)
        points = features_in_space(features.pixels, self.depth, camera)
        seen = points[:, 2] > 0
        return Landmarks(features.descriptors[seen], points[seen].astype(np.float32))


def features_in_space(pixels: np.ndarray, depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Points in the camera frame, float64 [n, 3], at pixels [n, 2] with the depth [H, W] of the nearest; 0 without."""
    column, row = np.rint(pixels).astype(int).T
    z = depth[np.clip(row, 0, camera.height - 1), np.clip(column, 0, camera.width - 1)].astype(float)
    x = (pixels[:, 0] - camera.cx) / camera.fx * z
    y = (pixels[:, 1] - camera.cy) / camera.fy * z
    return np.stack([x, y, z], 1)


@dataclass(frozen=True)
class FeaturePose:
    """A pose from feature matches.

    Attributes:
        T_world_camera: float64 [4, 4].
        matches: features of the two views that match and have depth.
        inliers: those that agree with the pose.
    """

    T_world_camera: np.ndarray
    matches: int
    inliers: int


@dataclass(frozen=True)
class ViewMatches:
    """Features of a view that match those of a located one.

    Attributes:
        points: float64 [m, 3], where the located view saw them, in its camera's frame, metres.
        pixels: float64 [m, 2], where the view sees them.
        T_world_known: float64 [4, 4], pose of the located view.
    """

    points: np.ndarray
    pixels: np.ndarray
    T_world_known: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    def which_agree(
        self, T_world_camera: np.ndarray, camera: Camera, settings: FeatureSettings, slack: float = 1.0
    ) -> np.ndarray:
        """Which of them the view sees where they have to be if it is at a pose [4, 4], bool [m]; `slack` widens the
        limit."""
        T = inverse(T_world_camera) @ self.T_world_known
        x, y, z = (self.points @ T[:3, :3].T + T[:3, 3]).T
        ahead = np.where(z > 0.05, z, np.inf)
        off = np.hypot(
            camera.fx * x / ahead + camera.cx - self.pixels[:, 0], camera.fy * y / ahead + camera.cy - self.pixels[:, 1]
        )
        return np.isfinite(ahead) & (off < slack * settings.limit(camera))

    def count_explained(
        self, T_world_camera: np.ndarray, camera: Camera, settings: FeatureSettings, slack: float = 1.0
    ) -> int:
        """How many are `which_agree`."""
        return int(self.which_agree(T_world_camera, camera, settings, slack).sum())

    def pose(self, camera: Camera, settings: FeatureSettings) -> FeaturePose | None:
        """The pose most of them agree on; None without enough of them. The same matches give the same pose."""
        if len(self) < settings.min_inliers:
            return None
        cv2.setRNGSeed(0)
        ok, rotation, translation, inliers = cv2.solvePnPRansac(
            self.points, self.pixels, camera.matrix(), None, iterationsCount=300,
            reprojectionError=settings.limit(camera), confidence=0.999, flags=cv2.SOLVEPNP_EPNP,
        )  # fmt: skip
        if not ok or inliers is None or len(inliers) < settings.min_inliers:
            return None
        chosen = inliers[:, 0]
        rotation, translation = cv2.solvePnPRefineLM(
            self.points[chosen], self.pixels[chosen], camera.matrix(), None, rotation, translation
        )
        T_view_known = np.eye(4)
        T_view_known[:3, :3] = cv2.Rodrigues(rotation)[0]
        T_view_known[:3, 3] = translation[:, 0]
        return FeaturePose(self.T_world_known @ inverse(T_view_known), len(self), len(chosen))


def match_views(view: FeatureView, known: FeatureView, camera: Camera, settings: FeatureSettings) -> ViewMatches:
    """Features of a view (whose own pose and depth are not used) that match those of a located one with depth."""
    known_features, found = known.features(settings), view.features(settings)
    if len(known_features.pixels) == 0 or len(found.pixels) == 0:
        return ViewMatches(np.zeros((0, 3)), np.zeros((0, 2)), known.T_world_camera)
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(known_features.descriptors, found.descriptors)
    matches = [m for m in matches if m.distance <= settings.max_hamming]
    pixels = known_features.pixels[[m.queryIdx for m in matches]].reshape(-1, 2)
    targets = found.pixels[[m.trainIdx for m in matches]].reshape(-1, 2)
    points = features_in_space(pixels, known.depth, camera)
    return ViewMatches(points[points[:, 2] > 0], targets[points[:, 2] > 0], known.T_world_camera)


def pose_from_matches(
    view: FeatureView, known: FeatureView, camera: Camera, settings: FeatureSettings
) -> FeaturePose | None:
    """Pose of a view (whose own pose and depth are not used) from its matches with a located one and that one's depth.

    RANSAC with EPnP, then Levenberg-Marquardt. The same images give the same pose.

    Returns:
        None without enough inliers.
    """
    return match_views(view, known, camera, settings).pose(camera, settings)
