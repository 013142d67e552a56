# SPDX-License-Identifier: Apache-2.0
"""What a map shows at a keyframe, and how the segments of the keyframe overlap with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.objects.settings import AssociationSettings


@dataclass(frozen=True)
class MapView:
    """What the map shows from the camera of a keyframe.

    Attributes:
        ids: uint16 [H, W], the object id with the largest rendering weight, 0 = nothing labelled.
        confidence: float32 [H, W], its share of the rendering weight.
        depth: float32 [H, W], rendered depth in metres, 0 = nothing.
    """

    ids: np.ndarray
    confidence: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True)
class SegmentOverlap:
    """Pixels that segments of a keyframe share with objects of the map.

    Attributes:
        segments: uint16 [S], ids of the segments, ascending, without 0.
        objects: uint16 [O], ids of the objects visible, ascending, without 0.
        shared: int64 [S, O], pixels where map and measurement show the same surface.
        area: int64 [S], all pixels of each segment.
        row, column: int32 [H, W], number of the pixel's segment and of the object that the map shows there with the
            same surface; -1 = none.
    """

    segments: np.ndarray
    objects: np.ndarray
    shared: np.ndarray
    area: np.ndarray
    row: np.ndarray
    column: np.ndarray

    @property
    def within(self) -> np.ndarray:
        """float [S, O]: share of the segment's known pixels that the object has."""
        return self.shared / np.maximum(self.shared.sum(1, keepdims=True), 1)

    @property
    def covers(self) -> np.ndarray:
        """float [S, O]: share of the object's segmented visible pixels that the segment has."""
        return self.shared / np.maximum(self.shared.sum(0), 1)


def number_ids(ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distinct ids of a uint16 image but 0, ascending, and the number of each pixel's among them (-1 for 0)."""
    present = np.bincount(ids.ravel(), minlength=1) > 0
    present[0] = False
    found = np.flatnonzero(present)
    table = np.full(len(present), -1, np.int32)
    table[found] = np.arange(len(found))
    return found.astype(np.uint16), table[ids]


def same_surface(view: MapView, depth: np.ndarray, settings: AssociationSettings) -> np.ndarray:
    """bool [H, W]: where the map shows the measured surface; where nothing was measured, the map is believed."""
    tolerance = np.maximum(settings.depth_tolerance_m, settings.depth_tolerance_relative * depth)
    return (view.depth > 0) & ((depth <= 0) | (np.abs(view.depth - depth) < tolerance))


def overlap_of(segments: np.ndarray, view: MapView, depth: np.ndarray, settings: AssociationSettings) -> SegmentOverlap:
    """Counts the pixels that `segments` (uint16 [H, W]) and the objects of `view` share."""
    known = same_surface(view, depth, settings) & (view.confidence >= settings.min_confidence)
    segment_ids, row = number_ids(segments)
    object_ids, column = number_ids(np.where(known, view.ids, np.uint16(0)))
    both = (row >= 0) & (column >= 0)
    shape = len(segment_ids), len(object_ids)
    pairs = row[both].astype(np.int64) * shape[1] + column[both]
    shared = np.bincount(pairs, minlength=shape[0] * shape[1]).reshape(shape)
    area = np.bincount(row[row >= 0], minlength=shape[0])
    return SegmentOverlap(segment_ids, object_ids, shared, area, row, column)
