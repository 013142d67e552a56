# SPDX-License-Identifier: Apache-2.0
"""How far points really are by the true poses: points matched in two colour images are triangulated, and what depth
says of them is held against that. It tells the unit of depth, and what its numbers mean."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.sequences.depth_kind import Measure
from ggslam.system.tuning import Tuning


class TriangulationTuning(Tuning):
    """How points are triangulated from true poses."""

    columns = (320, 480)
    """Fewest and most columns of the images that features are found in."""
    features = 500
    """SIFT features of an image (D. Lowe, IJCV 2004)."""
    contrast = 0.015
    """Their contrast threshold, lower than usual for plain walls."""
    max_match_ratio = 0.8
    """Largest ratio of the best and second best distance of descriptors."""
    min_angle_deg = 1.0
    """Smallest angle between the rays of a point, in degrees."""
    max_off_px = 1.5
    """Largest distance from the epipolar line, in pixels."""
    min_points = 60
    """Fewest points in all."""
    min_pairs = 2
    """Fewest pairs of frames that count."""
    min_points_of_pair = 8
    """Fewest points of a pair that counts."""
    alike = np.log(1.3)
    """Largest difference of the depth ratio between pairs of frames that agree (natural logarithm)."""


@dataclass(frozen=True)
class TruePoints:
    """Points whose distance true poses tell.

    Attributes:
        depth: as measured, float64 [n], metres if the depth scale is right and depth is z.
        z: along the optical axis, by the poses, float64 [n], metres.
        ray: length of the ray with z = 1, float64 [n].
        pair: number of the pair of frames, int [n].
    """

    depth: np.ndarray
    z: np.ndarray
    ray: np.ndarray
    pair: np.ndarray

    @property
    def tell(self) -> bool:
        """Whether there are enough."""
        _, counts = np.unique(self.pair, return_counts=True)
        return (
            len(self.z) >= TriangulationTuning.min_points
            and int((counts >= TriangulationTuning.min_points_of_pair).sum()) >= TriangulationTuning.min_pairs
        )

    def logs(self, measure: Measure) -> np.ndarray:
        """Logarithm of what stays the same over all points if depth is such, float64 [n]: of the ratio to the right z,
        or of the units of inverse depth."""
        log = np.log(self.depth)
        if measure == "ray":
            return np.asarray(log - np.log(self.z * self.ray))
        return np.asarray(log - np.log(self.z) if measure == "z" else log + np.log(self.z))

    def spread(self, measure: Measure) -> float:
        """Interquartile range of `logs`."""
        low, high = np.percentile(self.logs(measure), [25, 75])
        return float(high - low)

    def factor(self, measure: Measure) -> float:
        """Median by which measured depth is too large; of inverse depth, stored / depth scale at 1 m."""
        return float(np.exp(np.median(self.logs(measure))))

    def agree(self, measure: Measure) -> bool:
        """Whether each pair of frames tells about the same factor."""
        logs, whole = self.logs(measure), np.log(self.factor(measure))
        pairs, counts = np.unique(self.pair, return_counts=True)
        own = [np.median(logs[self.pair == k]) for k in pairs[counts >= TriangulationTuning.min_points_of_pair]]
        return float(np.mean(np.abs(np.array(own) - whole) < TriangulationTuning.alike)) >= 0.75


def triangulate(pairs: ListOf[tuple[Frame, Frame]]) -> TruePoints:
    """Points of the first frame of each pair that its true poses tell the distance of, where depth was measured."""
    found = [_points(number, first, second) for number, (first, second) in enumerate(pairs)]
    rows = np.concatenate([np.zeros((0, 4)), *found])
    return TruePoints(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3].astype(int))


def _points(number: int, first: Frame, second: Frame) -> np.ndarray:
    """Depth, true z, length of the ray, and the number, [n, 4]."""
    assert first.T_world_camera is not None and second.T_world_camera is not None
    matched = _match(first.color, second.color)
    if matched is None:
        return np.zeros((0, 4))
    c, here = first.camera, matched[0]
    a, b = (np.column_stack([(p[:, 0] - c.cx) / c.fx, (p[:, 1] - c.cy) / c.fy, np.ones(len(p))]) for p in matched)
    T = inverse(second.T_world_camera) @ first.T_world_camera
    turned, moved = a @ T[:3, :3].T, np.broadcast_to(T[:3, 3], b.shape)
    line = np.cross(moved, turned)
    off = np.abs((b * line).sum(1)) / np.maximum(np.linalg.norm(line[:, :2], axis=1), 1e-12) * c.fx
    # z turned + moved lies on the ray b, so b x turned z = - b x moved.
    across = np.cross(b, turned)
    length = np.linalg.norm(across, axis=1)
    z = -(across * np.cross(b, moved)).sum(1) / np.maximum(length**2, 1e-18)
    sine = length / np.linalg.norm(b, axis=1) / np.linalg.norm(turned, axis=1)
    columns, rows = np.rint(here).astype(int).T
    depth = first.depth[np.clip(rows, 0, c.height - 1), np.clip(columns, 0, c.width - 1)].astype(np.float64)
    good = (
        (off < TriangulationTuning.max_off_px)
        & (z > 0)
        & (sine > np.sin(np.radians(TriangulationTuning.min_angle_deg)))
        & (depth > 0)
    )
    ray = np.linalg.norm(a, axis=1)
    return np.column_stack([depth, z, ray, np.full(len(z), number)])[good]


def _match(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Columns and rows of the same points in two colour images, float64 [n, 2] each; None without any."""
    seen = [_features(image) for image in (first, second)]
    (a, words), (b, others) = seen
    if words is None or others is None or len(a) < 2 or len(b) < 2:
        return None
    two = cv2.BFMatcher().knnMatch(words, others, k=2)
    good = [m[0] for m in two if m[0].distance < TriangulationTuning.max_match_ratio * m[1].distance]
    return (a[[m.queryIdx for m in good]], b[[m.trainIdx for m in good]]) if good else None


def _features(color: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    width = color.shape[1]
    factor = float(np.clip(width, *TriangulationTuning.columns)) / width
    grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    way = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=way) if factor != 1 else grey
    limits = {"contrastThreshold": TriangulationTuning.contrast}
    sift = cv2.SIFT_create(TriangulationTuning.features, **limits)  # type: ignore[attr-defined]
    points, words = sift.detectAndCompute(grey, None)
    return (np.array([point.pt for point in points]).reshape(-1, 2) + 0.5) / factor - 0.5, words
