# SPDX-License-Identifier: Apache-2.0
"""Tracks movers, each from before it starts to move until it rests."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import cv2
import numpy as np

from ggslam.movers.mover_table import FoundMover, MoverSight
from ggslam.movers.patches import Patch
from ggslam.movers.recent import RecentFrame, Sight
from ggslam.movers.rigid import RigidTracker
from ggslam.scene.poses import inverse, transform_points, turning_angle
from ggslam.system.array_forms import Form
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class TrackTuning(Tuning):
    """Tracks of movers."""

    remembered_frames = 16
    """Frames that are searched when something starts to move."""
    rested_frames = 8
    """Frames at rest after which something counts as put down."""
    hidden_frames = 48
    """Frames for which a mover may be hidden."""
    min_own_segment = 0.5
    """Smallest share of a thing on one segment for it to be that segment."""
    min_overlap = 0.3
    """Smallest share of a mover's predicted surface on a thing for the two to be the same."""
    min_frames = 3
    """Fewest frames of a reported motion."""
    spread_pixels = 3
    """Distance from a surface's points, in pixels, at which it may be seen."""


@savable()
@dataclass
class Track:
    """One mover.

    Attributes:
        number: see `FoundMover`.
        instance: id of its segment in the recording's masks; None: it has none.
        found: frame in which it was found.
        tracker: where it is.
        sights: where it was while it moved.
        pending: where it stood in the latest frames.
        before, after: see `FoundMover`.
        scatter: metres and radians, before and after.
        stood: the same of the latest frames in which it stood.
        latest: what the latest frame showed of it, in its own frame.
        settled: whether it is no longer followed.
    """

    number: int
    instance: int | None
    found: int
    tracker: RigidTracker = field(default_factory=RigidTracker)
    sights: list[MoverSight] = field(default_factory=list)
    pending: list[MoverSight] = field(default_factory=list)
    before: MoverSight | None = None
    after: MoverSight | None = None
    scatter: Annotated[np.ndarray, Form("f8", 2, 2, finite=True)] = field(default_factory=lambda: np.zeros((2, 2)))
    stood: Annotated[np.ndarray, Form("f8", 2, finite=True)] = field(default_factory=lambda: np.zeros(2))
    latest: Patch | None = None
    settled: bool = False

    def follow(self, sight: Sight, view: RecentFrame, detected: bool) -> None:
        """Takes in what a frame shows of it; `detected`: and that it moves."""
        tracker = self.tracker
        if tracker.follow(sight.patch, sight.area, view.frame.index, sight.margin) is None:
            return
        own = sight.patch.move(inverse(tracker.T_world_mover))
        low, high = np.percentile(own.points, [2, 98], axis=0)
        T = inverse(view.T_world_camera) @ tracker.T_world_mover
        here = MoverSight(view.frame.index, T, low, high, sight.share)
        if self.latest is None or not tracker.flexible or len(own) >= len(self.latest):
            self.latest = own
        if tracker.stands:
            self.stood = _scatter(tracker.scatter, tracker.T_world_mover)
        if tracker.flexible:
            self.pending = []
            if detected:
                self.sights.append(here)
        elif tracker.stands or not (detected or tracker.shares):
            self.pending.append(here)
        else:
            self._go_on(here)

    def _go_on(self, here: MoverSight) -> None:
        """It moves; what it did before tells since when."""
        if here.frame <= self.found and len(self.pending) > 1:
            self.before, self.sights = self.pending[-1], []
            self.scatter[0] = self.stood
        elif not self.sights or len(self.pending) < TrackTuning.rested_frames:
            self.sights += self.pending  # it moved from the first frame on that showed it, or seemed to stand
        self.pending, self.after = [], None
        self.sights.append(here)

    def is_over(self, frame: int) -> bool:
        """Whether there is nothing more to follow, where it is not found to move."""
        if self.tracker.flexible:
            return not self.sights or frame - self.sights[-1].frame > TrackTuning.rested_frames
        return len(self.pending) >= TrackTuning.rested_frames or frame - self.tracker.frame > TrackTuning.hidden_frames

    def finish(self) -> None:
        """Ends the track: the mover has come to rest or is lost from sight."""
        if len(self.pending) >= TrackTuning.rested_frames and self.sights and not self.tracker.flexible:
            self.after = self.pending[-1]
            self.scatter[1] = self.stood
        self.settled = True

    def describe(self) -> FoundMover:
        """What is known of it."""
        surface, kind = self.tracker.surface, self.tracker.kind
        points, colors = surface.points, surface.colors
        sights, before, after = self.sights, self.before, self.after
        if after is None and len(self.pending) > 1:
            after, self.scatter[1] = self.pending[-1], self.stood  # the recording ends
        if kind == "not rigid":
            before = after = None
            points, colors = (self.latest.points, self.latest.colors) if self.latest is not None else (points, colors)
        elif len(points):
            low, high = np.percentile(points, [1, 99], axis=0)
            sights = [MoverSight(s.frame, s.T_camera_mover, low, high, s.share) for s in sights]
        scatter = np.sqrt((self.scatter**2).sum(0))
        return FoundMover(
            self.number, self.instance, kind, self.found, sights, before, after, float(scatter[0]),
            float(np.degrees(scatter[1])), points.astype(np.float32), colors.astype(np.float32),
        )  # fmt: skip


@savable(not_saved="recent")
@dataclass
class MoverTracks:
    """All movers of a run.

    Attributes:
        tracks: in the order in which they were found.
        recent: the latest frames, the newest last.
    """

    tracks: list[Track] = field(default_factory=list)
    recent: list[RecentFrame] = field(default_factory=list)

    def look(self, view: RecentFrame, things: np.ndarray | None) -> None:
        """Follows the movers into a frame.

        Args:
            view: the frame.
            things: int32 [H, W], number of the moving thing at each pixel, 0 without one; None: nothing moves.
        """
        if things is not None or self.tracks:
            self._follow(view, things)
        self.recent = [*self.recent[1 - TrackTuning.remembered_frames :], view]

    def _follow(self, view: RecentFrame, things: np.ndarray | None) -> None:
        active = [track for track in self.tracks if not track.settled]
        if things is None and not active:
            return
        segments = view.segments()
        masks = {} if things is None else self._assign(view, things, segments)
        for track in {id(t): t for t in [*active, *(self.tracks[k] for k in masks)]}.values():
            detected = masks.get(self.tracks.index(track))
            track.settled = track.settled and detected is None
            mask = detected
            if track.instance is not None and segments is not None:
                mask = segments == track.instance
            elif mask is None:
                mask = self._place_of(track, view)
            sight = view.show(mask)
            if sight is not None:
                track.follow(sight, view, detected is not None)
            if detected is None and track.is_over(view.frame.index):
                track.finish()

    def _assign(self, view: RecentFrame, things: np.ndarray, segments: np.ndarray | None) -> dict[int, np.ndarray]:
        """The mask of each mover that moves, by its place among `tracks`; new ones are begun."""
        found: dict[int, np.ndarray] = {}
        for number in np.unique(things[things > 0]):
            mask = things == number
            instance = None if segments is None else _segment_of(segments[mask])
            if instance is not None:
                own = [k for k, track in enumerate(self.tracks) if track.instance == instance]
            else:
                own = self._nearest(view, mask)
            if not own:
                if view.show(mask) is None:
                    continue
                self._begin(view, mask, instance)
                own = [len(self.tracks) - 1]
            found[own[0]] = found[own[0]] | mask if own[0] in found else mask
        return found

    def _nearest(self, view: RecentFrame, mask: np.ndarray) -> list[int]:
        """Which mover without a segment is expected where a thing is."""
        side = 2 * TrackTuning.spread_pixels + 1
        grown = cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
        shares = {}
        for k, track in enumerate(self.tracks):
            if track.instance is None and track.latest is not None:
                shares[k] = view_share(view, track, grown)
        best = max(shares, key=lambda k: shares[k], default=None)
        return [] if best is None or shares[best] < TrackTuning.min_overlap else [best]

    def _begin(self, view: RecentFrame, mask: np.ndarray, instance: int | None) -> None:
        """A mover that was not known; where its segment is known, it is followed from the oldest frame at hand."""
        taken = {track.number for track in self.tracks}
        free = next(n for n in range(1, len(taken) + 2) if n not in taken)
        number = instance if instance is not None and instance not in taken else free
        track = Track(number, instance, view.frame.index)
        self.tracks.append(track)
        if instance is None:
            return
        for earlier in self.recent:
            segments = earlier.segments()
            sight = None if segments is None else earlier.show(segments == instance)
            if sight is not None:
                track.follow(sight, earlier, False)

    @staticmethod
    def _place_of(track: Track, view: RecentFrame) -> np.ndarray:
        """Where a mover without a segment is seen that was not found to move."""
        points = transform_points(track.tracker.surface.points, track.tracker.predict(view.frame.index))
        return view.show_surface(points)

    def clear(self) -> None:
        """The row of frames was broken: what was remembered is of elsewhere."""
        self.recent = []

    def move(self, T_new_old: np.ndarray) -> None:
        """Follows a correction [4, 4] of the world."""
        for track in self.tracks:
            track.tracker.move(T_new_old)
        for view in self.recent:
            view.T_world_camera = T_new_old @ view.T_world_camera

    def describe(self) -> list[FoundMover]:
        """What is known of each that moved in more than a few frames."""
        found = []
        for track in self.tracks:
            if len(track.sights) >= TrackTuning.min_frames:
                found.append(track.describe())
        return found


def view_share(view: RecentFrame, track: Track, mask: np.ndarray) -> float:
    """Share of a mover's surface, where it is expected in a view, that is on a mask bool [H, W]."""
    assert track.latest is not None
    points = transform_points(track.latest.points, track.tracker.predict(view.frame.index))
    rows, columns, _ = view.project(points)
    return float(mask[rows, columns].sum()) / max(1, len(points))


def _segment_of(ids: np.ndarray) -> int | None:
    """The segment that most of a thing is on; None: most of it is on none."""
    counts = np.bincount(ids)
    counts[0] = 0
    best = int(counts.argmax())
    return best if counts[best] >= TrackTuning.min_own_segment * len(ids) else None


def _scatter(poses: list[np.ndarray], T: np.ndarray) -> np.ndarray:
    """Root mean square of metres and radians by which poses differ from one."""
    if not poses:
        return np.zeros(2)
    apart = np.array([[np.linalg.norm(P[:3, 3] - T[:3, 3]), turning_angle(P, T)] for P in poses])
    return np.asarray(np.sqrt((apart**2).mean(0)))
