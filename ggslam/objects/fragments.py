# SPDX-License-Identifier: Apache-2.0
"""Parts of an object that prove to be objects of their own.

A segment inside an object is either a piece of it, cut off this once, or something that was taken for a part of it
when both were first seen (in one segment, or from too far). The one comes at another place every time, the other
comes back at its place.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from ggslam.objects.overlap import SegmentOverlap
from ggslam.objects.segment_points import SegmentPoints
from ggslam.objects.settings import AssociationSettings
from ggslam.system.array_forms import ObjectId, Vector3
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class FragmentTuning(Tuning):
    """When a part may be an object of its own."""

    min_inside = 0.6
    """Smallest share of its segment inside the parent."""
    max_of_parent = 0.5
    """Largest share of the parent that it covers."""
    max_distance = 0.5
    """Largest distance between two sightings of one part, in radii of the smaller."""
    max_size_ratio = 1.6
    """Largest ratio of their radii."""


@savable()
@dataclass
class Fragment:
    """A place in the world where a part of an object was a segment of its own.

    Attributes:
        parent: id of the object that it is part of.
        centre: float64 [3], world, metres.
        radius: root mean square distance of its points from the centre.
        apart, together: keyframes in which it was a segment of its own, and in which it lay in the parent's.
        object_id: the id it got when it became an object; 0 before.
    """

    parent: ObjectId
    centre: Vector3
    radius: float
    apart: int = 1
    together: int = 0
    object_id: ObjectId = 0

    def is_like(self, other: Fragment) -> bool:
        """Whether both are the same part of the same object."""
        larger, smaller = max(self.radius, other.radius), min(self.radius, other.radius)
        near = math.dist(self.centre, other.centre) < FragmentTuning.max_distance * smaller
        return self.parent == other.parent and near and larger < FragmentTuning.max_size_ratio * smaller


@savable()
class FragmentMemory:
    """Collects fragments over keyframes."""

    _of: dict[ObjectId, list[Fragment]]

    def __init__(self, settings: AssociationSettings) -> None:
        self._settings = settings
        self._of = {}
        """Parent -> its fragments."""

    def observe(
        self, points: SegmentPoints, best: np.ndarray, T_world_camera: np.ndarray
    ) -> dict[int, Fragment]:
        """Takes a keyframe into account.

        Args:
            points: of its segments.
            best: int [S], number of the object each segment belongs to, -1 = none.
            T_world_camera: where the keyframe was taken.

        Returns:
            Segment number -> fragment, of the segments that are or have become objects of their own
            (`object_id` is still 0 for the latter).
        """
        found: dict[int, Fragment] = {}
        seen: list[Fragment] = []
        overlap = points.overlap
        minor = self._minor_segments(overlap, best)
        centres, radii = points.find_extents(np.array(minor))
        centres = centres @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        for k, centre, radius in zip(minor, centres, radii.tolist(), strict=True):
            now = Fragment(int(overlap.objects[best[k]]), centre, radius)
            if radius == 0:
                continue
            known = next((old for old in self._of.get(now.parent, []) if old.is_like(now)), None)
            if known is None:
                self._of.setdefault(now.parent, []).append(now)
                seen.append(now)
                continue
            known.apart += 1
            share = 1 / known.apart
            known.centre = (1 - share) * known.centre + share * now.centre
            known.radius = (1 - share) * known.radius + share * now.radius
            seen.append(known)
            if known.object_id or self._is_proven(known):
                found[k] = known
        self._note_absent(seen, minor, points, best, T_world_camera)
        return found

    def rename(self, kept: int, dropped: int) -> None:
        """An object became part of another one; a fragment that became an object and returned to its parent is
        forgotten."""
        for fragment in self._of.pop(dropped, []):
            fragment.parent = kept
            self._of.setdefault(kept, []).append(fragment)
        for parent, fragments in self._of.items():
            for fragment in fragments:
                fragment.object_id = kept if fragment.object_id == dropped else fragment.object_id
            self._of[parent] = [fragment for fragment in fragments if fragment.object_id != parent]

    def forget(self, object_ids: Collection[int]) -> None:
        """These objects are no more."""
        for i in object_ids:
            self._of.pop(i, None)
        for parent, fragments in self._of.items():
            self._of[parent] = [fragment for fragment in fragments if fragment.object_id not in object_ids]

    def _is_proven(self, fragment: Fragment) -> bool:
        enough = fragment.apart >= self._settings.split_observations
        return enough and fragment.apart > self._settings.split_ratio * fragment.together

    def _minor_segments(self, overlap: SegmentOverlap, best: np.ndarray) -> list[int]:
        """Segments that lie in an object of which another segment has more."""
        rows = np.flatnonzero(best >= 0)
        within, covers = overlap.within[rows, best[rows]], overlap.covers[rows, best[rows]]
        large = overlap.shared[rows, best[rows]] >= self._settings.min_visible * overlap.row.size
        largest = overlap.shared.max(0, initial=0)[best[rows]]
        minor = overlap.shared[rows, best[rows]] < largest
        return rows[
            minor & large & (within >= FragmentTuning.min_inside) & (covers < FragmentTuning.max_of_parent)
        ].tolist()

    def _note_absent(
        self, seen: list[Fragment], minor: list[int], view: SegmentPoints, best: np.ndarray, T_world_camera: np.ndarray
    ) -> None:
        """Fragments whose place is in view, but in the segment of the rest of their object."""
        overlap = view.overlap
        present = {id(fragment) for fragment in seen}
        visible = [f for parent in overlap.objects.tolist() for f in self._of.get(parent, [])]
        absent = [f for f in visible if not f.object_id and id(f) not in present]
        if not absent:
            return
        R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
        points = (np.stack([f.centre for f in absent]) - t) @ R
        rows, columns, inside = view.camera.project(points)
        for k in np.flatnonzero(inside):
            y, x = int(rows[k]), int(columns[k])
            segment, fragment = int(overlap.row[y, x]), absent[k]
            if segment < 0 or segment in minor or abs(view.depth[y, x] - points[k, 2]) > 2 * fragment.radius:
                continue
            if best[segment] >= 0 and overlap.objects[best[segment]] == fragment.parent:
                fragment.together += 1
