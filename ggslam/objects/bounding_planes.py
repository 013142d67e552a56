# SPDX-License-Identifier: Apache-2.0
"""Floors and walls that furniture divides: planes with nothing behind them.

A table top has the floor below it, a cupboard's front the wall behind it. Where nothing lies behind a plane it bounds
the room, and whatever lies on it, at either side of an island, is one floor or one wall.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from ggslam.objects.segment_points import SegmentPoints
from ggslam.system.array_forms import ObjectId, Vector3
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class BoundingPlaneTuning(Tuning):
    """When a segment is a floor or wall."""

    stride = 4
    """Every n-th pixel along each axis is used."""
    min_area = 0.02
    """Smallest share of the image."""
    min_on_plane = 0.9
    """Smallest share of its points on its plane."""
    flat_m = 0.03
    """Largest distance of these from it, in metres up to 3 m of depth; it grows in proportion beyond."""
    max_behind = 0.01
    """Largest share of all points behind the plane."""
    behind_m = 0.08
    """Distance from which they are behind it, in metres up to 2 m of depth; it grows in proportion beyond."""
    same_direction = 0.995
    """Smallest cosine between the normals of one plane in two views."""
    same_place_m = 0.04
    """Largest distance between them, in metres."""


@savable()
@dataclass
class BoundingPlane:
    """Unit normal [3] towards the camera, offset n . x, and the middle [3] of what was seen of it; world, metres."""

    normal: Vector3
    offset: float
    middle: Vector3


@savable()
class BoundingPlanes:
    """Remembers which objects are floors and walls."""

    _of: dict[ObjectId, BoundingPlane]

    def __init__(self) -> None:
        self._of = {}

    def look(self, points: SegmentPoints, T_world_camera: np.ndarray) -> dict[int, BoundingPlane]:
        """The planes of those segments of a keyframe that bound the room, by number of the segment. Of several on one
        plane only the largest: the others are pictures on the wall or rugs on the floor."""
        tuning, R, t = BoundingPlaneTuning, T_world_camera[:3, :3], T_world_camera[:3, 3]
        area = points.overlap.area
        order = np.argsort(-area, kind="stable")
        large = order[area[order] >= tuning.min_area * points.depth.size]
        planes = points.fit_planes(large, tuning.stride, tuning.flat_m, tuning.min_on_plane, tuning.behind_m)
        found: dict[int, BoundingPlane] = {}
        for k, plane in zip(large.tolist(), planes, strict=True):
            if plane is None or plane.behind >= tuning.max_behind:
                continue
            world = R @ plane.normal
            bounding = BoundingPlane(world, float(plane.offset + world @ t), R @ plane.middle + t)
            if not any(_are_one(bounding, other) for other in found.values()):
                found[k] = bounding
        return found

    def object_on(self, plane: BoundingPlane) -> int:
        """The object that lies on the plane; 0: none that is known."""
        for i, other in self._of.items():
            if _are_one(plane, other):
                return i
        return 0

    def note(self, object_id: int, plane: BoundingPlane) -> None:
        """An object is a floor or a wall; the last view counts."""
        self._of[object_id] = plane

    def rename(self, kept: int, dropped: int) -> None:
        """An object became part of another one."""
        plane = self._of.pop(dropped, None)
        if plane is not None:
            self._of.setdefault(kept, plane)

    def forget(self, object_ids: Collection[int]) -> None:
        """These objects are no more."""
        for i in object_ids:
            self._of.pop(i, None)


def _are_one(plane: BoundingPlane, other: BoundingPlane) -> bool:
    # Compared where either was seen: far from there, directions that are a little wrong say nothing.
    there = abs(plane.normal @ other.middle - plane.offset)
    here = abs(other.normal @ plane.middle - other.offset)
    return bool(
        plane.normal @ other.normal > BoundingPlaneTuning.same_direction
        and max(here, there) < BoundingPlaneTuning.same_place_m
    )
