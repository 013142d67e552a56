# SPDX-License-Identifier: Apache-2.0
"""What a map shows at a keyframe, and how the segments of the keyframe overlap with it."""

from __future__ import annotations

import ctypes
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from ggslam.abi import core
from ggslam.abi.arrays import address
from ggslam.native.loader import load_library
from ggslam.objects.settings import IDS, AssociationSettings
from ggslam.system.tuning import Tuning


class OverlapTuning(Tuning):
    """How overlaps are counted."""

    room = 1 << 14
    """Pairs of segments and objects, and of objects that touch, that there is room for at first."""


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
        touching: pairs of ids (smaller first) of objects that the map shows beside each other there.
    """

    segments: np.ndarray
    objects: np.ndarray
    shared: np.ndarray
    area: np.ndarray
    row: np.ndarray
    column: np.ndarray
    touching: Collection[tuple[int, int]] = ()

    @property
    def within(self) -> np.ndarray:
        """float [S, O]: share of the segment's known pixels that the object has."""
        return self.shared / np.maximum(self.shared.sum(1, keepdims=True), 1)

    @property
    def covers(self) -> np.ndarray:
        """float [S, O]: share of the object's segmented visible pixels that the segment has."""
        return self.shared / np.maximum(self.shared.sum(0), 1)

    def draw(self, labels: np.ndarray) -> np.ndarray:
        """An image uint16 [H, W] of `labels` uint16 [S + 1, O + 1], by segment and object of each pixel; the last row
        and column are for none."""
        labels, image = np.ascontiguousarray(labels, np.uint16), np.empty(self.row.shape, np.uint16)
        job = core.PairLabelsJob(
            address(self.row), address(self.column), address(labels), image.size, *self.shared.shape, address(image)
        )
        load_library().ggslam_label_pairs(ctypes.byref(job))
        return image


def distinct_ids(ids: np.ndarray) -> np.ndarray:
    """The distinct ids of a uint16 image but 0, ascending."""
    ids, there = np.ascontiguousarray(ids, np.uint16), np.empty(IDS, bool)
    load_library().ggslam_mark_ids(address(ids), ids.size, address(there))
    there[0] = False
    return np.flatnonzero(there).astype(np.uint16)


def overlap_of(
    segments: np.ndarray, view: MapView, depth: np.ndarray, settings: AssociationSettings, renamed: np.ndarray
) -> SegmentOverlap:
    """Counts the pixels that segments and the objects of a view share. Where nothing was measured, the map is believed.

    Args:
        segments: uint16 [H, W].
        view: what the map shows.
        depth: float32 [H, W], metres, 0 = unknown.
        settings: when map and measurement agree.
        renamed: uint16 [65536], what the objects of the view are called.
    """
    images = [
        np.ascontiguousarray(image, kind)
        for image, kind in (
            (segments, np.uint16), (view.ids, np.uint16), (renamed, np.uint16), (view.confidence, np.float32),
            (view.depth, np.float32), (depth, np.float32),
        )
    ]  # fmt: skip
    row, column = np.empty(segments.shape, np.int32), np.empty(segments.shape, np.int32)
    segment_ids, object_ids, areas = np.empty(IDS, np.uint16), np.empty(IDS, np.uint16), np.empty(IDS, np.int64)
    job = core.OverlapJob(
        *map(address, images), *segments.shape, settings.depth_tolerance_m, settings.depth_tolerance_relative,
        settings.min_confidence, row=address(row), column=address(column), segment_ids=address(segment_ids),
        object_ids=address(object_ids), areas=address(areas),
    )  # fmt: skip
    shared, touching = _count(job)
    found, known = job.segment_count, job.object_count
    pairs = [(low, high) for low, high in touching.tolist()]
    return SegmentOverlap(
        segment_ids[:found].copy(), object_ids[:known].copy(), shared, areas[:found].copy(), row, column, pairs
    )


def _count(job: core.OverlapJob) -> tuple[np.ndarray, np.ndarray]:
    """Does the job: shared pixels int64 [S, O], and pairs of touching objects int [n, 2]."""
    job.shared_room = job.touching_room = OverlapTuning.room
    while True:
        shared, touching = np.empty(job.shared_room, np.int64), np.empty((job.touching_room, 2), np.uint16)
        job.shared, job.touching = address(shared), address(touching)
        load_library().ggslam_segment_overlap(ctypes.byref(job))
        size = job.segment_count * job.object_count
        if size <= job.shared_room and job.touching_count <= job.touching_room:
            pixels = shared[:size].reshape(job.segment_count, job.object_count)
            return pixels, touching[: job.touching_count]
        job.shared_room, job.touching_room = max(size, job.shared_room), max(job.touching_count, job.touching_room)
