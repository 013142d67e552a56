# SPDX-License-Identifier: Apache-2.0
"""Locates frames by alignment to the map. A lost camera is located by known places or starts a new part."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ggslam.features.orb import FeatureView
from ggslam.scene.frame import Frame
from ggslam.slam.color_poses import ColorPoses
from ggslam.slam.config import Config
from ggslam.slam.filters.frame_filter import FrameFilter
from ggslam.slam.frame_poses import FramePoses
from ggslam.slam.left_parts import LeftParts
from ggslam.slam.loop_closing import LoopCloser
from ggslam.slam.part_start import PartStart, pose_apart
from ggslam.slam.parts import RunParts
from ggslam.slam.relocalization import Relocalizer
from ggslam.system.savable import savable
from ggslam.tracking.gicp import GicpTarget
from ggslam.tracking.keyframes import KeyframePolicy
from ggslam.tracking.tracker import TrackingResult, TrackingStatus


@dataclass(frozen=True)
class Located:
    """The poses of the frames of one instant, one frame of each camera.

    Attributes:
        frames: as they were located.
        joint: where the camera is; of a rig, where its first camera is by what all of them see.
        tracked: the same of each of the frames.
        early: keyframes that a part begins with, to be inserted before these frames. `FramePoses` knows them.
    """

    frames: list[Frame]
    joint: TrackingResult
    tracked: list[TrackingResult]
    early: Sequence[tuple[Frame, TrackingResult]] = ()

    @property
    def is_lost(self) -> bool:
        """Whether nothing tells where the frames are."""
        return self.joint.status is TrackingStatus.LOST


@savable(not_saved="before_search _config _surface _masks _tracker _relocalizer _pager _policy _poses _filters")
class FrameLocator:
    """Locates the frames of a camera.

    Args:
        config: all settings.
        parts: of the run.
        policy: chooses keyframes.
        poses: of the frames so far.
        filters: say what of a frame to align.
    """

    def __init__(
        self, config: Config, parts: RunParts, policy: KeyframePolicy, poses: FramePoses, filters: FrameFilter
    ) -> None:
        self._config, self._surface, self._masks = config, parts.surface, parts.masks
        self._tracker, self._pager = parts.tracker, parts.pager
        self._relocalizer = None if parts.loops is None else Relocalizer(parts.loops, parts.tracker)
        self._policy, self._poses, self._filters = policy, poses, filters
        self.color_poses = ColorPoses(parts.mapper, poses, parts.tracker.state)
        self.part_start, self.left_parts = PartStart(), LeftParts()
        self.before_search: Callable[[], Sequence[np.ndarray]] = tuple
        """Is called before a lost camera is looked for: all keyframes have to be known then. What it says has moved the
        world about the camera, [4, 4] each."""

    def target(self, published: GicpTarget | None) -> GicpTarget | None:
        """What the next frames are aligned to: the surface as it was published last, or what a part has begun with
        until the surface has that."""
        start = self.part_start
        if start.target is not None and len(self._surface) > start.keyframe:
            start.target = None
        return published if start.target is None else start.target

    def move(self, T_new_old: np.ndarray) -> None:
        """The world about the camera was moved by a correction [4, 4]; a locator of its own kind may hold a pose."""

    def locate(self, frames: list[Frame], growing: bool, takes_keyframes: bool) -> Located:
        """Locates the frames of an instant: of one camera there is one.

        Args:
            frames: as the run uses them.
            growing: whether keyframes are made at all.
            takes_keyframes: whether one may be made at this moment.
        """
        (frame,) = frames
        expected = self._filters.expect(frame)
        result, early = self._tracker.track(expected), list[tuple[Frame, TrackingResult]]()
        if result.status is TrackingStatus.LOST and self._relocalizer is not None and self._tracker.target is not None:
            for T_new_old in self.before_search():
                result = replace(result, T_world_camera=T_new_old @ result.T_world_camera)
            found = self._find_again(frame, expected, result, self._relocalizer)
            if found is not None:
                result = found
            elif growing and self._tracker.settings.recovery.new_part_after > 0 and self._pager is None:
                result, early = self._try_new_part(frame, result, self._relocalizer.loops, takes_keyframes)
        if result.status is not TrackingStatus.LOST:
            self.part_start.forget()
            self.left_parts.forget_targets()
        result = self.color_poses.align(frame, result)
        return Located([frame], result, [result], early)

    def keyframe_candidates(self, located: Located) -> list[int]:
        """Which of the frames of an instant that is not lost may become keyframes."""
        return list(range(len(located.frames)))

    def note(self, frame: Frame, tracking: TrackingResult) -> None:
        """The frame that `FramePoses` took last is no keyframe: it may be aligned to the finished map."""
        self.color_poses.note(frame, tracking)

    def _find_again(
        self, frame: Frame, expected: Frame, lost: TrackingResult, relocalizer: Relocalizer
    ) -> TrackingResult | None:  # fmt: skip
        """What tracking says of a lost frame that shows a known place, or what was in sight when the camera was lost
        before; None: neither."""
        found, loops = relocalizer.find(frame, lost), relocalizer.loops
        if found is None and self.left_parts.parts:
            found = self.left_parts.find(expected, self._poses.anchor[0], self._tracker, loops)
        if found is None:
            return None
        result, keyframe = found
        self._poses.anchor_to(keyframe, loops.poses[keyframe])
        return result

    def _try_new_part(
        self, frame: Frame, lost: TrackingResult, loops: LoopCloser, takes_keyframes: bool
    ) -> tuple[TrackingResult, list[tuple[Frame, TrackingResult]]]:
        """What tracking says of a lost frame that no place tells of: the same, or that a new part begins with it; and
        the keyframes that this begins with."""
        start = self.part_start
        start.watch(frame, lost, self._tracker, self._tracker.context)
        if self._config.evaluation.is_held_out(frame.index) or not takes_keyframes:
            return lost, []
        if start.is_due(frame, self._tracker):
            return self._begin_part(frame, lost, loops)
        start.keep(frame, self._masks.active, self._config.keyframes.max_gap)
        return lost, []

    def _begin_part(
        self, frame: Frame, lost: TrackingResult, loops: LoopCloser
    ) -> tuple[TrackingResult, list[tuple[Frame, TrackingResult]]]:
        """A part of the map begins with the frames that were lost; what tracking says of the last of them."""
        start, tracker, poses = self.part_start, self._tracker, self._poses
        self.left_parts.leave(*poses.anchor, tracker)
        T_world_first = pose_apart(lost.T_world_camera, self._surface.poses.array(), tracker.settings.points.max_depth)
        keyframe, first = poses.keyframes_made, start.first
        begun = start.begin(keyframe, lost, self._surface, T_world_first, tracker.context)
        loops.begin_part(begun.keyframes[0][0] if begun.keyframes else frame, first)
        poses.locate_last(keyframe, begun.T_first_camera)
        self._policy.begin_again()
        for early, tracking in begun.keyframes:
            self._policy.decide(early.index, tracking)
            poses.add_keyframe(tracking.T_world_camera)
        T = begun.T_world_camera
        return tracker.begin_part(FeatureView(frame.color, frame.depth, T), lost.points, T), begun.keyframes
