# SPDX-License-Identifier: Apache-2.0
"""Whether the focal length fits: two points of a rigid scene are as far apart in one view as in another, but only with
the right one, once the camera has turned between the views."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame

FACTORS = np.geomspace(1 / 2.6, 2.6, 29)
"""By which focal lengths are multiplied; 1 is among them."""
FEATURES, FEWEST_MATCHES, PAIRS = 600, 60, 3000
LEAST_SHIFT = 1.0
"""Pixels that most points have to move: images of a still camera, or that got stuck, tell nothing of a focal length."""
MOST_ALIKE = 0.75
"""Ratio of the best and second best distance of descriptors (D. Lowe, IJCV 2004)."""


@dataclass(frozen=True)
class FocalDoubt:
    """How rigid the scene looks.

    Attributes:
        error: median relative difference of distances with the focal length as it stands.
        factor, best: what the focal length is to be multiplied by to make that least, and then.
    """

    error: float
    factor: float
    best: float

    @property
    def wrong(self) -> bool:
        """Whether another focal length fits clearly better."""
        return abs(np.log(self.factor)) > np.log(1.2) and self.best < 0.6 * self.error and self.error > 0.01


def doubt_focal_length(pairs: list[tuple[Frame, Frame]]) -> FocalDoubt | None:
    """Looks for the focal length that makes distances of matched points agree best; None if too little is matched.

    Args:
        pairs: of frames that show much the same from different sides.
    """
    generator, errors = np.random.default_rng(0), []
    for first, second in pairs:
        matched = match_points(first, second)
        if matched is not None and _median_shift(*matched) >= LEAST_SHIFT:
            errors.append(_errors(*matched, first.camera, generator))
    if not errors:
        return None
    medians = np.median(np.concatenate(errors, 1), axis=1)
    best = int(medians.argmin())
    return FocalDoubt(float(medians[len(FACTORS) // 2]), float(FACTORS[best]), float(medians[best]))


def _median_shift(a: np.ndarray, b: np.ndarray) -> float:
    """Pixels by which matched points [n, 3] have moved in the image."""
    return float(np.median(np.linalg.norm(a[:, :2] - b[:, :2], axis=1)))


def match_points(first: Frame, second: Frame) -> tuple[np.ndarray, np.ndarray] | None:
    """Columns, rows and depth of the same points in two frames, float64 [n, 3] each; None if they are few."""
    seen = []
    for frame in (first, second):
        grey = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
        points, descriptors = cv2.ORB_create(FEATURES).detectAndCompute(grey, None)  # type: ignore[attr-defined]
        if descriptors is None or len(points) < FEWEST_MATCHES:
            return None
        pixels = np.array([point.pt for point in points])
        columns, rows = np.rint(pixels).astype(int).T
        seen.append((np.column_stack([pixels, frame.depth[rows, columns]]), descriptors))
    (a, words), (b, others) = seen
    two = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(words, others, k=2)
    good = [m[0] for m in two if len(m) == 2 and m[0].distance < MOST_ALIKE * m[1].distance]
    a, b = a[[m.queryIdx for m in good]], b[[m.trainIdx for m in good]]
    known = (a[:, 2] > 0) & (b[:, 2] > 0) if good else np.zeros(0, bool)
    return (a[known], b[known]) if known.sum() >= FEWEST_MATCHES else None


def _errors(a: np.ndarray, b: np.ndarray, camera: Camera, generator: np.random.Generator) -> np.ndarray:
    """Relative differences of distances between pairs of points, [factors, pairs]."""
    i, j = generator.integers(0, len(a), (2, PAIRS))
    lengths = []
    for seen in (a, b):
        rays = (seen[:, :2] - (camera.cx, camera.cy)) / (camera.fx, camera.fy) * seen[:, 2:]
        across = ((rays[i] - rays[j]) ** 2).sum(1)
        along = (seen[i, 2] - seen[j, 2]) ** 2
        lengths.append(np.sqrt(across / FACTORS[:, None] ** 2 + along))
    far = lengths[0][len(FACTORS) // 2] > 0.2 * np.median(a[:, 2])
    return np.abs(lengths[0] - lengths[1])[:, far] / np.maximum(lengths[0], lengths[1])[:, far]
