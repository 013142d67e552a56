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
from ggslam.system.tuning import Tuning


class FocalTuning(Tuning):
    """When a focal length is doubted."""

    factors = np.geomspace(1 / 2.6, 2.6, 29)
    """Factors that the focal length is multiplied by; 1 is in the middle."""
    features = 600
    """ORB features of an image."""
    min_matches = 40
    """Fewest matched points with depth."""
    point_pairs = 3000
    """Pairs of points whose distances are compared."""
    min_width = 320
    """Columns to which smaller images are enlarged: features need a margin of 31 pixels."""
    gaps = (12, 6, 3, 1)
    """Frames between two that are compared; the first one that leaves enough matches is used."""
    min_shift_px = 1.0
    """Median motion of points from which two images are compared, in pixels: still images tell nothing."""
    max_match_ratio = 0.75
    """Largest ratio of the best and second best distance of descriptors (D. Lowe, IJCV 2004)."""
    min_factor = 1.15
    """Factor, or its reciprocal, from which another focal length is reported. Sound recordings have 1.00."""
    min_error = 0.01
    """Error with the given focal length from which another one is reported. Sound recordings have 0.006 to 0.016."""
    max_error_left = 0.75
    """Largest share of the error that another focal length may leave."""
    same_factor = 1.15
    """Factor within which distances and rigid motion must agree; where large things move they do not."""
    tries = 120
    """Rigid motions that are tried."""
    inlier = 0.02
    """Distance of a point that follows a motion, as a share of its depth."""
    max_points = 150
    """Most points that motions are tried on."""


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
        off = abs(np.log(self.factor)) > np.log(FocalTuning.min_factor)
        return bool(off) and self.best < FocalTuning.max_error_left * self.error and self.error > FocalTuning.min_error

    @property
    def wrong(self) -> bool:
        """Whether another focal length fits clearly better, and one motion of the camera says so, too."""
        return self.suspicious and bool(abs(np.log(self.rigid / self.factor)) < np.log(FocalTuning.same_factor))

    @property
    def likely(self) -> float:
        """What the focal length is to be multiplied by: between what both say."""
        return float(np.sqrt(self.factor * self.rigid))


def pairs_matched(sequence: Sequence, frames: list[Frame]) -> list[tuple[Frame, Frame]]:
    """Each frame with a later one, as far on as enough points can be matched; without those that have none."""
    pairs = []
    for frame in frames:
        for gap in FocalTuning.gaps:
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
    matched = [found for found in matched if _median_shift(*found[:2]) >= FocalTuning.min_shift_px]
    if not matched:
        return None
    medians = np.median(np.concatenate([_errors(*found, generator) for found in matched], 1), axis=1)
    best = int(medians.argmin())
    doubt = FocalDoubt(
        float(medians[len(FocalTuning.factors) // 2]), float(FocalTuning.factors[best]), float(medians[best])
    )
    if not doubt.suspicious:
        return doubt
    misfits = np.sum([_misfits(*found, generator) for found in matched], axis=0)
    return replace(doubt, rigid=float(FocalTuning.factors[int(misfits.argmin())]))


def _median_shift(a: np.ndarray, b: np.ndarray) -> float:
    """Pixels by which matched points [n, 3] have moved in the image."""
    return float(np.median(np.linalg.norm(a[:, :2] - b[:, :2], axis=1)))


def match_points(first: Frame, second: Frame) -> tuple[np.ndarray, np.ndarray] | None:
    """Columns, rows and depth of the same points in two frames, float64 [n, 3] each; None if they are few."""
    seen = []
    for frame in (first, second):
        grey = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
        factor = max(1.0, FocalTuning.min_width / grey.shape[1])
        large = grey if factor == 1 else cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_LINEAR)
        points, descriptors = cv2.ORB_create(FocalTuning.features).detectAndCompute(large, None)  # type: ignore[attr-defined]
        if descriptors is None or len(points) < FocalTuning.min_matches:
            return None
        pixels = (np.array([point.pt for point in points]) + 0.5) / factor - 0.5
        columns, rows = np.clip(np.rint(pixels).astype(int), 0, (grey.shape[1] - 1, grey.shape[0] - 1)).T
        seen.append((np.column_stack([pixels, frame.depth[rows, columns]]), descriptors))
    (a, words), (b, others) = seen
    two = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(words, others, k=2)
    good = [m[0] for m in two if len(m) == 2 and m[0].distance < FocalTuning.max_match_ratio * m[1].distance]
    a, b = a[[m.queryIdx for m in good]], b[[m.trainIdx for m in good]]
    known = (a[:, 2] > 0) & (b[:, 2] > 0) if good else np.zeros(0, bool)
    return (a[known], b[known]) if known.sum() >= FocalTuning.min_matches else None


def _errors(a: np.ndarray, b: np.ndarray, camera: Camera, generator: np.random.Generator) -> np.ndarray:
    """Relative differences of distances between pairs of points, [factors, pairs]."""
    i, j = generator.integers(0, len(a), (2, FocalTuning.point_pairs))
    lengths = []
    for seen in (a, b):
        rays = _across(seen, camera)
        across = ((rays[i] - rays[j]) ** 2).sum(1)
        along = (seen[i, 2] - seen[j, 2]) ** 2
        lengths.append(np.sqrt(across / FocalTuning.factors[:, None] ** 2 + along))
    far = lengths[0][len(FocalTuning.factors) // 2] > 0.2 * np.median(a[:, 2])
    return np.abs(lengths[0] - lengths[1])[:, far] / np.maximum(lengths[0], lengths[1])[:, far]


def _across(seen: np.ndarray, camera: Camera) -> np.ndarray:
    """Metres right and down of points [n, 3], [n, 2]."""
    return (seen[:, :2] - (camera.cx, camera.cy)) / (camera.fx, camera.fy) * seen[:, 2:]


def _misfits(a: np.ndarray, b: np.ndarray, camera: Camera, generator: np.random.Generator) -> np.ndarray:
    """How badly points follow the rigid motion that most of them follow, of each factor [factors]: sums of residuals
    over depth, each at most `FocalTuning.inlier`."""
    kept = generator.permutation(len(a))[: FocalTuning.max_points]
    a, b = a[kept], b[kept]
    chosen, misfits = generator.integers(0, len(a), (FocalTuning.tries, 3)), []
    for factor in FocalTuning.factors:
        source, target = (np.column_stack([_across(seen, camera) / factor, seen[:, 2]]) for seen in (a, b))
        T, _ = fit_similarity(source[chosen], target[chosen])
        off = _residuals(T, source, target)
        best = off[int(np.minimum(off, FocalTuning.inlier).sum(1).argmin())]
        if (best < FocalTuning.inlier).sum() >= 10:
            refined, _ = fit_similarity(
                source[best < FocalTuning.inlier][None], target[best < FocalTuning.inlier][None]
            )
            best = _residuals(refined, source, target)[0]
        misfits.append(float(np.minimum(best, FocalTuning.inlier).sum()))
    return np.array(misfits)


def _residuals(T: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Distances of points [n, 3] moved by each T [m, 4, 4] to where they were seen, over their depth, [m, n]."""
    moved = np.einsum("kij,nj->kni", T[:, :3, :3], source) + T[:, None, :3, 3]
    return np.linalg.norm(moved - target, axis=2) / target[:, 2]
