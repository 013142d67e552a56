# SPDX-License-Identifier: Apache-2.0
"""Relocalization: finding a lost camera again at the places of all keyframes."""

from __future__ import annotations

from ggslam.features.orb import FeatureView
from ggslam.scene.frame import Frame
from ggslam.slam.loop_closing import LoopCloser
from ggslam.tracking.tracker import Tracker, TrackingResult


class Relocalizer:
    """Finds lost frames. It may be called from the tracker's thread while the mapper's adds keyframes.

    Args:
        loops: knows the keyframes' places.
        tracker: goes on where a frame is found.
    """

    def __init__(self, loops: LoopCloser, tracker: Tracker) -> None:
        self.loops, self._tracker = loops, tracker

    def find(self, frame: Frame, lost: TrackingResult) -> tuple[TrackingResult, int] | None:
        """Looks a lost frame up among all keyframes; the tracker goes on from there.

        Returns:
            What tracking says now, and the number of the keyframe it was found at; None if none leads to a pose.
        """
        if len(lost.points) < self._tracker.settings.align.min_matches:
            return None
        with self.loops.work():
            return self._find_among_all(frame, lost)

    def _find_among_all(self, frame: Frame, lost: TrackingResult) -> tuple[TrackingResult, int] | None:
        loops = self.loops
        view = FeatureView(frame.color, frame.depth, lost.T_world_camera)
        place = loops.places.describe(view, frame.camera)
        for match in loops.places.query(place, loops.settings.candidates):
            found, alignment = loops.compare(frame.camera, lost.points, place, match.number)
            if not found.accepted or alignment is None:
                continue
            old = match.number
            reason = f"keyframe {old}: {found.inliers} features, {found.overlap:.0%} of the voxels"
            loops.go_on_at(frame, old, reason)
            return self._tracker.relocate(view, lost.points, alignment, reason), old
        return None
