# SPDX-License-Identifier: Apache-2.0
"""Floors and walls that furniture divides: planes with nothing behind them.

A table top has the floor below it, a cupboard's front the wall behind it. Where nothing lies behind a plane it bounds
the room, and whatever lies on it, at either side of an island, is one floor or one wall.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from ggslam.objects.overlap import SegmentOverlap
from ggslam.scene.camera import Camera
from ggslam.system.array_forms import ObjectId, Vector3
from ggslam.system.savable import savable

_STRIDE = 4
_LEAST = 0.02
"""Share of the image that a segment has at least."""
_ON, _FLAT = 0.9, 0.03
"""Share of a segment's points that lie within so many metres, plus as much of their depth / 3, of its plane."""
_BEHIND, _BEYOND = 0.01, 0.08
"""Share of all points that may lie farther behind the plane than so many metres."""
_SAME_DIRECTION, _SAME_PLACE = 0.995, 0.04
"""Cosine of the angle, and metres, between planes that are one."""


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

    def look(
        self, overlap: SegmentOverlap, depth: np.ndarray, camera: Camera, T_world_camera: np.ndarray
    ) -> dict[int, BoundingPlane]:
        """The planes of those segments of a keyframe that bound the room, by number of the segment. Of several on one
        plane only the largest: the others are pictures on the wall or rugs on the floor."""
        z = depth[::_STRIDE, ::_STRIDE].ravel()
        seen = np.flatnonzero(z > 0)
        rays = camera.rays()[::_STRIDE, ::_STRIDE].reshape(-1, 3)
        points = rays[seen].astype(np.float64) * z[seen][:, None]
        row = overlap.row[::_STRIDE, ::_STRIDE].ravel()[seen]
        found: dict[int, BoundingPlane] = {}
        order = np.argsort(-overlap.area, kind="stable")
        for k in order[overlap.area[order] >= _LEAST * overlap.row.size].tolist():
            own = points[row == k]
            plane = _fit(own) if len(own) >= 10 else None
            if plane is None:
                continue
            normal, offset = plane
            if np.mean(points @ normal - offset < -_BEYOND * np.maximum(1, points[:, 2] / 2)) < _BEHIND:
                world = T_world_camera[:3, :3] @ normal
                middle = T_world_camera[:3, :3] @ own.mean(0) + T_world_camera[:3, 3]
                bounding = BoundingPlane(world, float(offset + world @ T_world_camera[:3, 3]), middle)
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
    return bool(plane.normal @ other.normal > _SAME_DIRECTION and max(here, there) < _SAME_PLACE)


def _fit(points: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Unit normal towards the camera and offset of the plane that most of the points [n, 3] lie on; None: no plane."""
    near = np.ones(len(points), bool)
    for _ in range(3):
        if near.sum() < 10:
            return None
        centre = points[near].mean(0)
        normal = np.linalg.eigh(np.cov((points[near] - centre).T))[1][:, 0]
        away = np.abs((points - centre) @ normal)
        near = away <= max(float(np.median(away)) * 3, 1e-3)
    if np.mean(away < _FLAT * np.maximum(1, points[:, 2] / 3)) < _ON:
        return None
    if normal @ centre > 0:
        normal = -normal
    return normal, float(normal @ centre)
