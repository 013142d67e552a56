# SPDX-License-Identifier: Apache-2.0
"""Association as it is done in numpy, pixel by pixel: the tests' reference for the compiled core's passes."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from ggslam.objects.association import Association, Associator, MatchTuning
from ggslam.objects.bounding_planes import BoundingPlane
from ggslam.objects.fragments import Fragment
from ggslam.objects.overlap import SegmentOverlap
from ggslam.objects.segment_points import SegmentPlane, SegmentPoints
from ggslam.scene.camera import Camera


class ReferencePoints(SegmentPoints):
    """By the same names."""

    def find_extents(self, segments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        row, depth = self.overlap.row, self.depth
        place = np.full(int(row.max(initial=0)) + 2, -1)  # the last one: no segment
        place[segments.astype(int)] = np.arange(len(segments))
        inside = np.flatnonzero((place[row] >= 0) & (depth > 0))
        which, n = place[row.ravel()[inside]], len(segments)
        points = self.camera.rays().reshape(-1, 3)[inside] * depth.ravel()[inside][:, None].astype(np.float64)
        count = np.maximum(np.bincount(which, minlength=n), 1)
        centre = np.stack([np.bincount(which, points[:, k], n) / count for k in range(3)], 1)
        square = np.bincount(which, ((points - centre[which]) ** 2).sum(1), n) / count
        return centre, np.sqrt(square)

    def fit_planes(
        self, segments: np.ndarray, stride: int, flat_m: float, min_on_plane: float, behind_m: float
    ) -> list[SegmentPlane | None]:
        z = self.depth[::stride, ::stride].ravel()
        seen = np.flatnonzero(z > 0)
        rays = self.camera.rays()[::stride, ::stride].reshape(-1, 3)
        points = rays[seen].astype(np.float64) * z[seen][:, None]
        row = self.overlap.row[::stride, ::stride].ravel()[seen]
        found: list[SegmentPlane | None] = []
        for k in segments.tolist():
            own = points[row == k]
            plane = fit_plane(own, flat_m, min_on_plane) if len(own) >= 10 else None
            if plane is None:
                found.append(None)
                continue
            normal, offset = plane
            behind = np.mean(points @ normal - offset < -behind_m * np.maximum(1, points[:, 2] / 2))
            found.append(SegmentPlane(normal, offset, own.mean(0), float(behind)))
        return found


def fit_plane(points: np.ndarray, flat_m: float, min_on_plane: float) -> tuple[np.ndarray, float] | None:
    """Unit normal towards the camera and offset of the plane that most of the points [n, 3] lie on; None: no plane."""
    near = np.ones(len(points), bool)
    for _ in range(3):
        if near.sum() < 10:
            return None
        centre = points[near].mean(0)
        normal = np.linalg.eigh(np.cov((points[near] - centre).T))[1][:, 0]
        away = np.abs((points - centre) @ normal)
        near = away <= max(float(np.median(away)) * 3, 1e-3)
    if np.mean(away < flat_m * np.maximum(1, points[:, 2] / 3)) < min_on_plane:
        return None
    if normal @ centre > 0:
        normal = -normal
    return normal, float(normal @ centre)


class ReferenceAssociator(Associator):
    """Draws images of ids where the other looks them up."""

    def _choose(
        self, overlap: SegmentOverlap, depth: np.ndarray, camera: Camera | None, T_world_camera: np.ndarray | None
    ) -> tuple[np.ndarray, dict[int, Fragment], dict[int, BoundingPlane]]:
        best = self._best(overlap)
        parts: dict[int, Fragment] = {}
        planes: dict[int, BoundingPlane] = {}
        if camera is not None and T_world_camera is not None:
            points = ReferencePoints(overlap, depth, camera)
            parts = self._fragments.observe(points, best, T_world_camera)
            planes = self._planes.look(points, T_world_camera)
        return best, parts, planes

    def _match(
        self, overlap: SegmentOverlap, best: np.ndarray, parts: dict[int, Fragment],
        planes: dict[int, BoundingPlane],
    ) -> Association:  # fmt: skip
        covered = self._find_covered(overlap)
        created: list[int] = []
        ids = np.zeros(len(overlap.segments) + 1, np.uint16)  # the last one: no segment
        for k in range(len(overlap.segments)):
            if k in parts and parts[k].object_id:
                ids[k] = parts[k].object_id
            elif best[k] >= 0 and k not in parts:
                ids[k] = overlap.objects[best[k]]
            elif k in planes and (wall := self._planes.object_on(planes[k])) and wall not in overlap.objects:
                ids[k] = wall
            else:
                ids[k] = self._new_id(int(overlap.segments[k]))
                created += [int(ids[k])] if ids[k] else []
            if k in planes and ids[k]:
                self._planes.note(int(ids[k]), planes[k])
            if k in parts:
                if not parts[k].object_id:
                    self._evidence.take_over(parts[k].parent, int(ids[k]), parts[k].together, parts[k].apart)
                parts[k].object_id = int(ids[k])
                covered[k] = False
        image = ids[overlap.row]
        self._keep_known(image, overlap, covered, best, parts, planes)
        self._evidence.observe(overlap, overlap.touching)
        merges = self._evidence.merges()
        for kept, dropped in merges:
            self._rename(kept, dropped)
        splits = [(part.parent, part.object_id) for part in parts.values() if part.object_id]
        return Association(self._current[image] if merges else image, merges, created, splits)

    def _keep_known(
        self, image: np.ndarray, overlap: SegmentOverlap, covered: np.ndarray, best: np.ndarray, parts: Collection[int],
        planes: Collection[int],
    ) -> None:  # fmt: skip
        """Where a segment has several objects, the map's labels stand, and new ground is nobody's unless one object
        dominates, or the segment is a floor or a wall, of which corners were seen before."""
        rows = np.array([k for k in np.flatnonzero(best >= 0) if k not in parts], int)
        covered[rows, best[rows]] = True
        for k in np.flatnonzero(covered.sum(1) > 1):
            inside = overlap.row == k
            column = overlap.column[inside]
            keep = (column >= 0) & covered[k, column]
            label = np.where(keep, overlap.objects[column], image[inside])
            if overlap.within[k].max() < MatchTuning.dominant and k not in planes:
                label[column < 0] = 0
            image[inside] = label
