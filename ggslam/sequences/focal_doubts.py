# SPDX-License-Identifier: Apache-2.0
"""Whether the focal length fits: two points of a rigid scene are as far apart in one view as in another, but only with
the right one, once the camera has turned between the views."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import fit_similarity
from ggslam.sequences.sequence import Sequence

FACTORS = np.geomspace(1 / 2.6, 2.6, 29)
"""By which focal lengths are multiplied; 1 is among them."""
FEATURES, FEWEST_MATCHES, PAIRS = 600, 40, 3000
SMALLEST = 320
"""Columns to which smaller images are enlarged: features need a margin of 31 pixels."""
GAPS = (12, 6, 3, 1)
"""Frames between two that are compared: the first number that leaves enough matches."""
LEAST_SHIFT = 1.0
"""Pixels that most points have to move: images of a still camera, or that got stuck, tell nothing of a focal length."""
MOST_ALIKE = 0.75
"""Ratio of the best and second best distance of descriptors (D. Lowe, IJCV 2004)."""
LEAST_FACTOR, LEAST_ERROR, MOST_LEFT = 1.15, 0.01, 0.75
"""How far the best focal length has to be off, the least error as it stands, and the share of it that may be left with
the best. Sound recordings have a factor of 1.00 and an error of 0.006 to 0.016."""
SAME_FACTOR = 1.15
"""Within which distances of pairs and one rigid motion have to tell the same: where big things move they do not."""
TRIES, TOLERANCE, MOST_POINTS = 120, 0.02, 150
"""Motions that are tried, share of the depth within which a point follows one, and points that are looked at."""


@dataclass(frozen=True)
class FocalDoubt:
    """How rigid the scene looks.

    Attributes:
        error: median relative difference of distances with the focal length as it stands.
        factor, best: what the focal length is to be multiplied by to make that least, and then.
        rigid: the factor with which most points follow one rigid motion; NaN: it was not looked for, for nothing is
            suspicious.
    """

    error: float
    factor: float
    best: float
    rigid: float = float("nan")

    @property
    def suspicious(self) -> bool:
        """Whether distances agree clearly better with another focal length."""
        off = abs(np.log(self.factor)) > np.log(LEAST_FACTOR)
        return bool(off) and self.best < MOST_LEFT * self.error and self.error > LEAST_ERROR

    @property
    def wrong(self) -> bool:
        """Whether another focal length fits clearly better, and one motion of the camera says so, too."""
        return self.suspicious and bool(abs(np.log(self.rigid / self.factor)) < np.log(SAME_FACTOR))

    @property
    def likely(self) -> float:
        """What the focal length is to be multiplied by: between what both say."""
        return float(np.sqrt(self.factor * self.rigid))


def pairs_matched(sequence: Sequence, frames: list[Frame]) -> list[tuple[Frame, Frame]]:
    """Each frame with a later one, as far on as enough points can be matched; without those that have none."""
    pairs = []
    for frame in frames:
        for gap in GAPS:
            try:
                later = sequence.frame(frame.index + gap, masks=False) if frame.index + gap < len(sequence) else None
            except SequenceError:
                continue
            if later is not None and match_points(frame, later) is not None:
                pairs.append((frame, later))
                break
    return pairs


def doubt_focal_length(pairs: list[tuple[Frame, Frame]]) -> FocalDoubt | None:
    """Looks for the focal length that makes distances of matched points agree best; None if too little is matched.

    Args:
        pairs: of frames that show much the same from different sides.
    """
    generator = np.random.default_rng(0)
    matched = [(*found, first.camera) for first, second in pairs if (found := match_points(first, second)) is not None]
    matched = [found for found in matched if _median_shift(*found[:2]) >= LEAST_SHIFT]
    if not matched:
        return None
    medians = np.median(np.concatenate([_errors(*found, generator) for found in matched], 1), axis=1)
    best = int(medians.argmin())
    doubt = FocalDoubt(float(medians[len(FACTORS) // 2]), float(FACTORS[best]), float(medians[best]))
    if not doubt.suspicious:
        return doubt
    misfits = np.sum([_misfits(*found, generator) for found in matched], axis=0)
    return replace(doubt, rigid=float(FACTORS[int(misfits.argmin())]))


def _median_shift(a: np.ndarray, b: np.ndarray) -> float:
    """Pixels by which matched points [n, 3] have moved in the image."""
    return float(np.median(np.linalg.norm(a[:, :2] - b[:, :2], axis=1)))


def match_points(first: Frame, second: Frame) -> tuple[np.ndarray, np.ndarray] | None:
    """Columns, rows and depth of the same points in two frames, float64 [n, 3] each; None if they are few."""
    seen = []
    for frame in (first, second):
        grey = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
        factor = max(1.0, SMALLEST / grey.shape[1])
        large = grey if factor == 1 else cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_LINEAR)
        points, descriptors = cv2.ORB_create(FEATURES).detectAndCompute(large, None)  # type: ignore[attr-defined]
        if descriptors is None or len(points) < FEWEST_MATCHES:
            return None
        pixels = (np.array([point.pt for point in points]) + 0.5) / factor - 0.5
        columns, rows = np.clip(np.rint(pixels).astype(int), 0, (grey.shape[1] - 1, grey.shape[0] - 1)).T
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
        rays = _across(seen, camera)
        across = ((rays[i] - rays[j]) ** 2).sum(1)
        along = (seen[i, 2] - seen[j, 2]) ** 2
        lengths.append(np.sqrt(across / FACTORS[:, None] ** 2 + along))
    far = lengths[0][len(FACTORS) // 2] > 0.2 * np.median(a[:, 2])
    return np.abs(lengths[0] - lengths[1])[:, far] / np.maximum(lengths[0], lengths[1])[:, far]


def _across(seen: np.ndarray, camera: Camera) -> np.ndarray:
    """Metres right and down of points [n, 3], [n, 2]."""
    return (seen[:, :2] - (camera.cx, camera.cy)) / (camera.fx, camera.fy) * seen[:, 2:]


def _misfits(a: np.ndarray, b: np.ndarray, camera: Camera, generator: np.random.Generator) -> np.ndarray:
    """How badly points follow the rigid motion that most of them follow, of each factor [factors]: sums of residuals
    over depth, each at most `TOLERANCE`."""
    kept = generator.permutation(len(a))[:MOST_POINTS]
    a, b = a[kept], b[kept]
    chosen, misfits = generator.integers(0, len(a), (TRIES, 3)), []
    for factor in FACTORS:
        source, target = (np.column_stack([_across(seen, camera) / factor, seen[:, 2]]) for seen in (a, b))
        T, _ = fit_similarity(source[chosen], target[chosen])
        off = _residuals(T, source, target)
        best = off[int(np.minimum(off, TOLERANCE).sum(1).argmin())]
        if (best < TOLERANCE).sum() >= 10:
            refined, _ = fit_similarity(source[best < TOLERANCE][None], target[best < TOLERANCE][None])
            best = _residuals(refined, source, target)[0]
        misfits.append(float(np.minimum(best, TOLERANCE).sum()))
    return np.array(misfits)


def _residuals(T: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Distances of points [n, 3] moved by each T [m, 4, 4] to where they were seen, over their depth, [m, n]."""
    moved = np.einsum("kij,nj->kni", T[:, :3, :3], source) + T[:, None, :3, 3]
    return np.linalg.norm(moved - target, axis=2) / target[:, 2]
