# SPDX-License-Identifier: Apache-2.0
"""Locates a rig of cameras by aligning the points of all of them together, as one body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ggslam.features.orb import FeatureView
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.scene.rig import Rig
from ggslam.slam.config import Config
from ggslam.slam.filters.frame_filter import FrameFilter
from ggslam.slam.frame_locator import FrameLocator, Located
from ggslam.slam.frame_poses import FramePoses
from ggslam.slam.parts import RunParts
from ggslam.slam.rig_clock import RigClock
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning
from ggslam.tracking.gicp_tracker import GicpTracker
from ggslam.tracking.keyframes import KeyframePolicy
from ggslam.tracking.noise import estimate_noise
from ggslam.tracking.rig_engine import RigTrackingEngine, RigView
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.tracker import TrackingResult, TrackingStatus


class DarkImageTuning(Tuning):
    """When an image of a rig counts as dark."""

    max_grey = 12
    """Brightest grey level, of 255, of an image that shows nothing."""
    stride = 8
    """Distance, in rows and columns, between the pixels that are looked at."""


@savable(
    not_saved="before_search _config _surface _masks _tracker _relocalizer _pager _policy _poses _filters "
    "_rig _engine _chains"
)
class RigLocator(FrameLocator):
    """See `FrameLocator`. A camera that sees nothing, or has no frame at an instant, is carried along by the others.
    No parts begin in a lost rig, and colour does not correct its poses.

    Args:
        rig: the cameras.
        config: all settings.
        parts: of the run.
        policy: chooses keyframes.
        poses: of the frames so far.
        chains: the filters of each camera's frames.
    """

    def __init__(
        self, rig: Rig, config: Config, parts: RunParts, policy: KeyframePolicy, poses: FramePoses,
        chains: Sequence[FrameFilter],
    ) -> None:  # fmt: skip
        super().__init__(config, parts, policy, poses, FrameFilter())
        assert isinstance(self._tracker, GicpTracker)
        self._rig, self._clock, self._chains = rig, RigClock(), chains
        self._engine = RigTrackingEngine(parts.context)
        self._tracker.engine = self._engine

    def move(self, T_new_old: np.ndarray) -> None:
        """The world about the rig was moved by a correction [4, 4]."""
        self._clock.move(T_new_old)

    def locate(self, frames: list[Frame], growing: bool, takes_keyframes: bool) -> Located:
        """Locates the frames of an instant, one of each camera that has one."""
        now = frames[0].timestamp
        expected = [self._chains[frame.camera_number].expect(frame) for frame in frames]
        self._engine.views = [RigView(f.camera, f.depth, self._T_first_of(f, now)) for f in expected]
        joint = self._locate(expected, self._lead(expected))
        self._clock.follow(None if joint.status is TrackingStatus.LOST else joint.T_world_camera, now)
        return Located(frames, joint, self._of_frames(frames, joint, now))

    def keyframe_candidates(self, located: Located) -> list[int]:
        """See `FrameLocator`: those that show something and whose motion since the first one's time is known."""
        frames, now = located.frames, located.frames[0].timestamp
        needed, black = self._tracker.settings.align.min_matches, [_is_black(frame) for frame in frames]
        return [
            k for k, frame in enumerate(frames)
            if len(located.tracked[k].points) >= needed and self._clock.knows(frame.timestamp - now)
            and (not black[k] or all(black))
        ]  # fmt: skip

    def note(self, frame: Frame, tracking: TrackingResult) -> None:
        """Nothing: frames of a rig stay as the rig has them."""

    def _locate(self, frames: list[Frame], lead: Frame) -> TrackingResult:
        """Where the rig is; one that is lost is looked up among all keyframes."""
        if self._tracker.noise is None and not lead.depth.any():
            told = (estimate_noise(frame.depth, frame.camera) for frame in frames)
            self._tracker.noise = next((noise for noise in told if noise is not None), None)
        joint = self._tracker.track(lead)
        if joint.status is not TrackingStatus.LOST or self._relocalizer is None or self._tracker.target is None:
            return joint
        now = frames[0].timestamp
        for frame, part in zip(frames, self._engine.parts, strict=True):
            T_first_camera = self._T_first_of(frame, now)
            T_lost = joint.T_world_camera @ T_first_camera
            found = self._relocalizer.find(frame, replace(joint, points=part, T_world_camera=T_lost))
            if found is not None:
                result, keyframe = found
                self._poses.anchor_to(keyframe, self._relocalizer.loops.poses[keyframe])
                T = result.T_world_camera @ inverse(T_first_camera)
                view, motion = FeatureView(lead.color, lead.depth, T), self._tracker.state.motion
                motion.restart(view, T)
                motion.remember(view, joint.points, self._tracker.settings)
                return replace(result, T_world_camera=T, points=joint.points)
        return joint

    def _T_first_of(self, frame: Frame, now: float) -> np.ndarray:
        """From a frame's camera to the first one's as it was at a time, seconds."""
        return self._clock.motion_in(frame.timestamp - now) @ self._rig.T_first_camera[frame.camera_number]

    def _lead(self, frames: list[Frame]) -> Frame:
        """The first camera's frame; where that shows nothing, one without anything."""
        lead = frames[0]
        if lead.camera_number == 0 and not _is_black(lead):
            return lead
        first = self._rig.cameras[0]
        size = (first.height, first.width)
        return replace(lead, color=np.zeros((*size, 3), np.uint8), depth=np.zeros(size, np.float32), camera=first)

    def _of_frames(self, frames: list[Frame], joint: TrackingResult, now: float) -> list[TrackingResult]:
        """The same for each of the frames: its pose, its own points, and how well they fit."""
        parts, shares = self._engine.parts, list[float | None]([None] * len(frames))
        if joint.gicp is not None and len(joint.gicp.matches.read().voxels) == sum(map(len, parts)):
            noise = self._tracker.noise or DepthNoise()
            shares = self._engine.overlaps(joint.gicp, self._tracker.settings.align, noise)
        return [
            replace(
                joint, points=part, overlap=joint.overlap if share is None else share,
                T_world_camera=joint.T_world_camera @ self._T_first_of(frame, now),
            ) for frame, part, share in zip(frames, parts, shares, strict=True)
        ]  # fmt: skip


def _is_black(frame: Frame) -> bool:
    """Whether an image shows nothing."""
    return int(frame.color[::DarkImageTuning.stride, ::DarkImageTuning.stride].max()) <= DarkImageTuning.max_grey
