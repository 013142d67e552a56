# SPDX-License-Identifier: Apache-2.0
"""From segments of single frames to objects that keep their ids: matching with what the map already shows.

The map's labels, rendered into the keyframe, take the place of a tracker: a segment belongs to the object it overlaps
where map and measurement show the same surface. Wrong beginnings are repaired by evidence that gathers over keyframes.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from ggslam.objects.bounding_planes import BoundingPlane, BoundingPlanes
from ggslam.objects.consistency import ConsistencyJudge
from ggslam.objects.evidence import PairEvidence
from ggslam.objects.fragments import Fragment, FragmentMemory
from ggslam.objects.overlap import MapView, SegmentOverlap, distinct_ids, overlap_of
from ggslam.objects.segment_points import SegmentPoints
from ggslam.objects.settings import IDS, AssociationSettings
from ggslam.scene.camera import Camera
from ggslam.system.array_forms import Form, ObjectId
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning

__all__ = ["Association", "Associator", "MapView"]

_log = logging.getLogger(__name__)


class MatchTuning(Tuning):
    """When a segment is an object of the map."""

    min_pixels = 5
    """Fewest pixels that a segment shares with an object."""
    dominant = 0.8
    """Share of a segment in one object from which it is mostly that object."""
    min_within = 0.3
    """Smallest share of a segment that lies in an object it may belong to."""
    min_covered = 0.2
    """Smallest share of that object which the segment covers."""


@dataclass(frozen=True)
class Association:
    """Object ids of one keyframe.

    Attributes:
        ids: uint16 [H, W], object id of each pixel, 0 = leave unlabelled.
        merges: (kept, dropped) pairs, in order, of objects that turned out to be one: relabel the map.
        created: ids that appear for the first time.
        splits: (whole, part) pairs: the map still shows the whole where `ids` has the part. Votes that the whole has
            on those pixels were wrong; without taking them back, the part prevails once it has more of its own.
        forgotten: ids of objects that no later keyframe found again: they are none.
    """

    ids: np.ndarray
    merges: list[tuple[int, int]] = field(default_factory=list)
    created: list[int] = field(default_factory=list)
    splits: list[tuple[int, int]] = field(default_factory=list)
    forgotten: list[int] = field(default_factory=list)


@savable()
class Associator:
    """Gives the segments of keyframe after keyframe ids that stay with their objects.

    Args:
        settings: thresholds and mode.
        reserved: ids that are not given to new objects (because they carry names), unless the mask says so itself.

    Attributes:
        sightings: object id -> keyframes in which it was given to a segment. What was seen once is mostly noise of the
            segmenter.
    """

    _current: Annotated[np.ndarray, Form("u2", 65536)]
    _used: Annotated[np.ndarray, Form("?", 65536)]
    _blocked: Annotated[np.ndarray, Form("?", 65536)]
    _doubted: list[tuple[int, list[ObjectId]]]
    sightings: dict[ObjectId, int]

    def __init__(self, settings: AssociationSettings | None = None, reserved: Collection[int] = ()) -> None:
        self._settings = settings or AssociationSettings()
        self._judge = ConsistencyJudge()
        self._evidence = PairEvidence(self._settings)
        self._fragments = FragmentMemory(self._settings)
        self._planes = BoundingPlanes()
        self._current = np.arange(IDS).astype(np.uint16)
        """Id -> id of the object that it is part of by now."""
        self._used = np.zeros(IDS, bool)
        self._blocked = np.zeros(IDS, bool)
        self._blocked[[0, *reserved]] = True
        self._highest = 0
        self._ran_out = False
        self._keyframes = 0
        self._doubted = []
        """Keyframes that created objects, and these, until it shows whether they are found again."""
        self.sightings = {}

    @property
    def uses_own_ids(self) -> bool | None:
        """Whether the masks' own ids are handed through; None: not settled yet."""
        if self._settings.mode == "auto":
            return self._judge.consistent
        return self._settings.mode == "never"

    def associate(
        self, segments: np.ndarray, view: MapView | None, depth: np.ndarray, camera: Camera | None = None,
        T_world_camera: np.ndarray | None = None,
    ) -> Association:  # fmt: skip
        """Ids for the segments of the next keyframe.

        Args:
            segments: uint16 [H, W], ids of this frame's segments, 0 = unlabelled; cleaned (see `clean_segments`).
            view: what the map shows from here; None before there is a map.
            depth: float32 [H, W], measured depth in metres, 0 = unknown.
            camera, T_world_camera: where the keyframe was taken. Without them objects are never split.

        Raises:
            ValueError: images of different size.
        """
        sizes = {image.shape for image in (segments, depth, *((view.ids, view.confidence, view.depth) if view else ()))}
        if len(sizes) > 1:
            raise ValueError(f"segments, depth and view must have one size, found {sorted(sizes)}")
        if view is None:
            view = MapView(np.zeros_like(segments), np.zeros_like(depth), np.zeros_like(depth))
        overlap = overlap_of(segments, view, depth, self._settings, self._current)
        if self._settings.mode == "auto" and len(overlap.objects):
            before = self._judge.consistent
            if self._judge.observe(segments, overlap) != before:
                _log.info("ids of the masks are %sconsistent over time", "" if self._judge.consistent else "not ")
        if self.uses_own_ids:
            result = self._own_ids(segments, overlap)
        else:
            result = self._match(overlap, *self._choose(overlap, depth, camera, T_world_camera))
        for i in distinct_ids(result.ids).tolist():
            self.sightings[i] = self.sightings.get(i, 0) + 1
        for kept, dropped in result.merges:
            self._join_sightings(kept, dropped)
        return result if self.uses_own_ids else replace(result, forgotten=self._forget(result.created))

    def unite(self, kept: int, dropped: int) -> None:
        """Two objects are one, as others found out: the map is relabelled by them."""
        self._evidence.join(kept, dropped)
        self._rename(kept, dropped)
        self._join_sightings(kept, dropped)

    def _rename(self, kept: int, dropped: int) -> None:
        """What was called `dropped` is called `kept` from now on."""
        self._current[self._current == dropped] = kept
        self._fragments.rename(kept, dropped)
        self._planes.rename(kept, dropped)

    def _join_sightings(self, kept: int, dropped: int) -> None:
        self.sightings[kept] = max(self.sightings.get(kept, 0), self.sightings.pop(dropped, 0))

    def _forget(self, created: list[int]) -> list[int]:
        """Objects created long ago that no keyframe has found again."""
        self._keyframes += 1
        if created:
            self._doubted.append((self._keyframes, created))
        gone: list[int] = []
        while self._doubted and self._keyframes - self._doubted[0][0] > self._settings.patience:
            gone += [i for i in self._doubted.pop(0)[1] if self.sightings.get(i) == 1]
        if gone:
            self._current[np.isin(self._current, gone)] = 0
            self._evidence.forget(set(gone))
            self._fragments.forget(set(gone))
            self._planes.forget(gone)
            for i in gone:
                del self.sightings[i]
        return gone

    def _choose(
        self, overlap: SegmentOverlap, depth: np.ndarray, camera: Camera | None, T_world_camera: np.ndarray | None
    ) -> tuple[np.ndarray, dict[int, Fragment], dict[int, BoundingPlane]]:
        best = self._best(overlap)
        parts: dict[int, Fragment] = {}
        planes: dict[int, BoundingPlane] = {}
        if camera is not None and T_world_camera is not None:
            points = SegmentPoints(overlap, depth, camera)
            parts = self._fragments.observe(points, best, T_world_camera)
            planes = self._planes.look(points, T_world_camera)
        return best, parts, planes

    def _own_ids(self, segments: np.ndarray, overlap: SegmentOverlap) -> Association:
        new = overlap.segments[~self._used[overlap.segments]].tolist()
        self._used[new] = True
        self._highest = max([self._highest, *new])
        # Own ids prove that what was merged before the verdict was not one.
        self._current = np.arange(IDS).astype(np.uint16)
        return Association(segments.copy(), [], new)

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
        labels = self._label_pairs(ids, overlap, covered, best, parts, planes)
        self._evidence.observe(overlap, overlap.touching)
        merges = self._evidence.merges()
        for kept, dropped in merges:
            self._rename(kept, dropped)
        splits = [(part.parent, part.object_id) for part in parts.values() if part.object_id]
        return Association(overlap.draw(self._current[labels] if merges else labels), merges, created, splits)

    def _find_covered(self, overlap: SegmentOverlap) -> np.ndarray:
        """bool [S, O]: objects that a segment has as a whole, or with a large share of both."""
        within, covers, visible = overlap.within, overlap.covers, overlap.shared.sum(0)
        seen = visible >= self._settings.min_visible * overlap.row.size
        return ((covers >= self._settings.whole) & seen) | (
            (within >= MatchTuning.min_within) & (covers >= MatchTuning.min_covered)
        )

    def _best(self, overlap: SegmentOverlap) -> np.ndarray:
        """int [S]: number of the object a segment belongs to, -1 = none that the map shows."""
        best = np.full(len(overlap.segments), -1)
        if not len(overlap.objects):
            return best
        s, shared, within, covers = self._settings, overlap.shared, overlap.within, overlap.covers
        # Both shares count: a mug is not its table's although its rim may show the table, nor is the table the mug's.
        score = np.where(within >= MatchTuning.min_within, within + covers, within - 2)
        chosen = score.argmax(1)
        rows = np.arange(len(chosen))
        share = shared[rows, chosen] / overlap.area
        continues = (share >= s.min_continuation) & (covers[rows, chosen] >= 0.5) & (within[rows, chosen] >= 0.5)
        accepted = (shared[rows, chosen] >= MatchTuning.min_pixels) & ((share >= s.min_overlap) | continues)
        best[accepted] = chosen[accepted]
        return best

    def _label_pairs(
        self, ids: np.ndarray, overlap: SegmentOverlap, covered: np.ndarray, best: np.ndarray, parts: Collection[int],
        planes: Collection[int],
    ) -> np.ndarray:  # fmt: skip
        """uint16 [S + 1, O + 1]: the label where segment and object meet, by the ids of segments [S + 1]; the last ones
        are none. Where a segment has several objects, the map's labels stand, and new ground is nobody's unless one
        object dominates, or the segment is a floor or a wall, of which corners were seen before."""
        rows = np.array([k for k in np.flatnonzero(best >= 0) if k not in parts], int)
        covered[rows, best[rows]] = True
        several = covered.sum(1) > 1
        labels = np.repeat(ids[:, None], len(overlap.objects) + 1, axis=1)
        labels[:-1, :-1] = np.where(covered & several[:, None], overlap.objects, labels[:-1, :-1])
        within = overlap.within
        for k in np.flatnonzero(several).tolist():
            if within[k].max() < MatchTuning.dominant and k not in planes:
                labels[k, -1] = 0
        return labels

    def _new_id(self, wanted: int) -> int:
        """The mask's own id if no object ever had it, else the next one free; 0 when none is left."""
        if self._used[wanted]:
            wanted = self._next_free(self._highest + 1) or self._next_free(1)
            if not wanted:
                if not self._ran_out:
                    _log.warning("more than 65535 objects: further ones stay unlabelled")
                self._ran_out = True
                return 0
        self._used[wanted] = True
        self._highest = max(self._highest, wanted)
        return wanted

    def _next_free(self, begin: int) -> int:
        """The first id from `begin` on that no object ever had and that is not reserved; 0: there is none."""
        taken = self._used[begin:] | self._blocked[begin:]
        first = int(taken.argmin()) if len(taken) else 0
        return begin + first if len(taken) and not taken[first] else 0
