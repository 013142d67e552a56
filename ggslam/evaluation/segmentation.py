# SPDX-License-Identifier: Apache-2.0
"""Scores of object masks against true instance masks, over all views of a set together.

IoU of an object counts its pixels in all views; boundary IoU (Cheng et al., "Boundary IoU: Improving Object-Centric
Image Segmentation Evaluation", CVPR 2021) counts only pixels within a distance of the contour, so that a shifted rim of
a wall is not hidden by its area. Pixels whose true id is 0 are ignored. An object that is not predicted scores zero.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from ggslam.errors import InputError

FOUND_IOU: Final = 0.5
"""An object counts as found above this IoU, as in panoptic quality: no two masks can claim the same object."""


@dataclass(frozen=True)
class Matching:
    """Which predicted id stands for which true id.

    Attributes:
        kind: "same": equal ids; "assignment": one to one, of largest total IoU.
        predicted: true id -> predicted id; true ids without one are missing.
    """

    kind: str
    predicted: Mapping[int, int]


@dataclass(frozen=True)
class ObjectScore:
    """Of one true object: IoU and boundary IoU over all views, the predicted id it was compared with (0: none), and its
    true pixels."""

    iou: float
    boundary_iou: float
    matched: int
    pixels: int


@dataclass(frozen=True)
class SegmentationScores:
    """Scores of a set of views. NaN where there is nothing to score.

    Attributes:
        frames: views counted.
        objects: true objects seen.
        predicted_objects: predicted ids seen on labelled pixels.
        miou, boundary_miou: means over the true objects; one without a prediction counts as zero.
        accuracy: share of the labelled pixels with the right id.
        precision, recall, f1: of objects, found with IoU above `FOUND_IOU`.
        panoptic_quality: mean IoU of the found objects times f1 (Kirillov et al., "Panoptic Segmentation", CVPR 2019).
        matching: how ids were matched, see `Matching`.
        per_object: scores of each true id.
    """

    frames: int = 0
    objects: int = 0
    predicted_objects: int = 0
    miou: float = math.nan
    boundary_miou: float = math.nan
    accuracy: float = math.nan
    precision: float = math.nan
    recall: float = math.nan
    f1: float = math.nan
    panoptic_quality: float = math.nan
    matching: str = "same"
    per_object: dict[int, ObjectScore] = field(default_factory=dict)


class SegmentationCounts:
    """Adds up what the scores need; as sparse as the pairs of ids that meet.

    Args:
        boundary: distance to the contour that counts as boundary, as a share of the image's diagonal; None leaves
            boundary IoU out (NaN).
    """

    def __init__(self, boundary: float | None = 0.02) -> None:
        self.boundary = boundary
        self.frames = 0
        self._pairs: dict[tuple[int, int], np.ndarray] = {}  # (true, predicted) -> pixels in common, all and boundary
        self._true_boundary: dict[int, int] = {}
        self._predicted_boundary: dict[int, int] = {}

    def add(self, predicted: np.ndarray, truth: np.ndarray) -> None:
        """Counts one view.

        Args:
            predicted: ids uint16 [H, W]; 0 (no object) on a labelled pixel counts as a miss.
            truth: true ids uint16 [H, W]; pixels of 0 are ignored.

        Raises:
            InputError: other shapes or types.
        """
        for name, image in (("predicted", predicted), ("truth", truth)):
            if image.ndim != 2 or image.dtype != np.uint16:
                raise InputError(f"{name}: expected ids uint16 [H, W], found {image.dtype} {list(image.shape)}")
        if predicted.shape != truth.shape:
            raise InputError(f"sizes differ: predicted {list(predicted.shape)}, truth {list(truth.shape)}")
        self.frames += 1
        labelled = truth > 0
        true_ids, t = _compact(truth[labelled])
        predicted_ids, p = _compact(predicted[labelled])
        shape = (len(true_ids), len(predicted_ids))
        pair = t * shape[1] + p
        common = np.bincount(pair, minlength=shape[0] * shape[1])
        at_boundary = np.zeros_like(common)
        if self.boundary is not None:
            distance = boundary_distance(truth.shape, self.boundary)
            near_t = boundary_band(truth, distance)[labelled]
            near_p = boundary_band(np.where(labelled, predicted, np.uint16(0)), distance)[labelled]
            at_boundary = np.bincount(pair[near_t & near_p], minlength=len(common))
            _add(self._true_boundary, true_ids, np.bincount(t[near_t], minlength=shape[0]))
            _add(self._predicted_boundary, predicted_ids, np.bincount(p[near_p], minlength=shape[1]))
        for k in np.flatnonzero(common):
            key = (int(true_ids[k // shape[1]]), int(predicted_ids[k % shape[1]]))
            self._pairs[key] = self._pairs.get(key, 0) + np.array([common[k], at_boundary[k]])

    def merge(self, other: SegmentationCounts) -> None:
        """Adds the views of another count."""
        self.frames += other.frames
        for key, counts in other._pairs.items():
            self._pairs[key] = self._pairs.get(key, 0) + counts
        for mine, theirs in (
            (self._true_boundary, other._true_boundary),
            (self._predicted_boundary, other._predicted_boundary),
        ):
            for name, count in theirs.items():
                mine[name] = mine.get(name, 0) + count

    def match(self, matching: str = "auto") -> Matching:
        """Matches predicted to true ids.

        Args:
            matching: "same": equal ids; "assignment": one to one so that the sum of IoU is largest; "auto": "same" if
                that reaches at least half of the mIoU of the assignment, as it does when the map was supervised with
                the true ids.

        Raises:
            InputError: none of these.
        """
        if matching not in ("same", "assignment", "auto"):
            raise InputError(f"matching: expected same, assignment or auto, found {matching!r}")
        table = self._table()
        same = Matching("same", {i: i for i in map(int, np.intersect1d(table.true_ids, table.predicted_ids))})
        if matching == "same":
            return same
        iou = table.iou()
        rows, columns = linear_sum_assignment(iou, maximize=True)
        pairs = zip(rows, columns, strict=True)
        chosen = {int(table.true_ids[r]): int(table.predicted_ids[c]) for r, c in pairs if iou[r, c] > 0}
        assigned = Matching("assignment", chosen)
        total_same = sum(iou[table.row(t), table.column(p)] for t, p in same.predicted.items())
        # An empty assignment is no better than equal ids: both score zero.
        use_same = matching == "auto" and total_same >= 0.5 * iou[rows, columns].sum()
        return same if use_same else assigned

    def scores(self, matching: str | Matching = "auto") -> SegmentationScores:
        """The scores of what was counted so far.

        Args:
            matching: as in `match`, or a matching made there (of a larger set, say).
        """
        table = self._table()
        if not isinstance(matching, Matching):
            matching = self.match(matching)
        if not len(table.true_ids):
            return SegmentationScores(self.frames, matching=matching.kind)
        per_object = {}
        right = 0.0
        for row, name in enumerate(map(int, table.true_ids)):
            partner = matching.predicted.get(name, 0)
            column = table.column(partner)
            common, iou = 0.0, 0.0
            if column is not None:
                common = float(table.common[row, column])
                iou = float(_ratio(common, table.true_area[row], table.predicted_area[column]))
            right += common
            per_object[name] = ObjectScore(
                iou, self._boundary_iou(name, partner), 0 if column is None else partner, int(table.true_area[row])
            )
        return _summary(self.frames, per_object, len(table.predicted_ids), right, matching.kind)

    def _boundary_iou(self, true_id: int, predicted_id: int) -> float:
        if self.boundary is None:
            return math.nan
        common = self._pairs.get((true_id, predicted_id), np.zeros(2))[1] if predicted_id else 0
        found = self._predicted_boundary.get(predicted_id, 0) if predicted_id else 0
        return float(_ratio(common, self._true_boundary[true_id], found))

    def _table(self) -> _Table:
        true_ids = np.unique([t for t, _ in self._pairs])
        predicted_ids = np.unique([p for _, p in self._pairs if p])
        common = np.zeros((len(true_ids), len(predicted_ids)))
        area = np.zeros(len(true_ids))
        for (t, p), counts in self._pairs.items():
            row = np.searchsorted(true_ids, t)
            area[row] += counts[0]
            if p:
                common[row, np.searchsorted(predicted_ids, p)] = counts[0]
        return _Table(true_ids, predicted_ids, common, area, common.sum(0))


@dataclass(frozen=True)
class _Table:
    """Dense counts: sorted ids, pixels in common [T, P], areas [T] and [P]."""

    true_ids: np.ndarray
    predicted_ids: np.ndarray
    common: np.ndarray
    true_area: np.ndarray
    predicted_area: np.ndarray

    def iou(self) -> np.ndarray:
        """[T, P]."""
        return _ratio(self.common, self.true_area[:, None], self.predicted_area[None, :])

    def row(self, true_id: int) -> int:
        return int(np.searchsorted(self.true_ids, true_id))

    def column(self, predicted_id: int) -> int | None:
        column = int(np.searchsorted(self.predicted_ids, predicted_id))
        return column if column < len(self.predicted_ids) and self.predicted_ids[column] == predicted_id else None


def _ratio(common: Any, a: Any, b: Any) -> Any:
    """Intersection over union of areas a and b."""
    return common / np.maximum(a + b - common, 1)


def _summary(
    frames: int, per_object: dict[int, ObjectScore], predicted: int, right: float, kind: str
) -> SegmentationScores:
    iou = np.array([score.iou for score in per_object.values()])
    found = iou > FOUND_IOU
    hits, objects = int(found.sum()), len(iou)
    f1 = 2 * hits / (objects + predicted)
    return SegmentationScores(
        frames=frames, objects=objects, predicted_objects=predicted, miou=float(iou.mean()),
        boundary_miou=float(np.mean([score.boundary_iou for score in per_object.values()])),
        accuracy=right / sum(score.pixels for score in per_object.values()),
        precision=hits / predicted if predicted else math.nan, recall=hits / objects, f1=f1,
        panoptic_quality=float(iou[found].mean()) * f1 if hits else 0.0, matching=kind, per_object=per_object,
    )  # fmt: skip


def boundary_distance(shape: tuple[int, ...], share: float) -> int:
    """Pixels that `share` of the diagonal of an image [H, W] is, at least 1."""
    return max(1, round(share * math.hypot(*shape[:2])))


def boundary_band(ids: np.ndarray, distance: int) -> np.ndarray:
    """bool [H, W]: pixels of a mask that its erosion by a square of 2 `distance` + 1 takes away, for all ids uint16 at
    once. What is beyond the image's border belongs to no mask."""
    square = np.ones((2 * distance + 1, 2 * distance + 1), np.uint8)
    lowest = cv2.erode(ids, square, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return lowest != cv2.dilate(ids, square)


def _compact(ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The ids that occur, sorted, and the place of each pixel's id among them, int64. Quicker than np.unique."""
    present = np.flatnonzero(np.bincount(ids, minlength=1))
    place = np.zeros(1 << 16, np.int64)
    place[present] = np.arange(len(present))
    return present, place[ids]


def _add(sums: dict[int, int], ids: np.ndarray, counts: np.ndarray) -> None:
    for name, count in zip(ids.tolist(), counts.tolist(), strict=True):
        sums[name] = sums.get(name, 0) + count
