# SPDX-License-Identifier: Apache-2.0
"""Moves depth that was taken before or after colour to the time of colour, along the camera's motion."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ggslam.geometry.moved_depth import largest_shift, moved_depth
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp, se3_log
from ggslam.slam.filters.frame_filter import FrameFilter, InRigs
from ggslam.system.array_forms import Pose
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.tracker import TrackingResult, TrackingStatus


class ShutterTuning(Tuning):
    """Alignment of depth and colour images that were taken at different times."""

    min_shift_pixels = 0.5
    """Smallest shift between depth and colour that is corrected, in pixels at a corner of the image."""
    max_interval_s = 0.2
    """Longest time between two frames from which the motion at the shutter is interpolated, in seconds."""
    max_delay_share = 0.6
    """Largest delay of depth that is corrected, as a share of the time between two frames."""


_TOGETHER = np.eye(4)


@savable()
@dataclass
class ShutterTimes(FrameFilter):
    """Predicts the pose of the depth camera from its motion between the last images.

    Attributes:
        motion: [4, 4], from one of its poses to the next; None: not known.
        interval: the time that took, seconds.
        T_color_depth: [4, 4], of the frame at hand: its depth as it was taken against its colour.
        time: when that was, seconds.
        T_world_depth: where the depth camera was before, None if it was not located; `time_before` when.
    """

    order = 20
    in_rigs = InRigs.PER_CAMERA

    motion: Pose | None = None
    interval: float = 0.0
    T_color_depth: Pose = field(default_factory=lambda: np.eye(4))
    time: float = 0.0
    T_world_depth: Pose | None = None
    time_before: float = 0.0

    def clean(self, frame: Frame) -> Frame:
        """The frame with depth as of the time of its colour: itself if they are together, or hardly anything moves."""
        self.time, self.T_color_depth = frame.timestamp + frame.depth_delay, _TOGETHER
        if not frame.depth_delay or self.motion is None or not 0 < self.interval <= ShutterTuning.max_interval_s:
            return frame
        share = frame.depth_delay / self.interval
        known = frame.depth[frame.depth > 0]
        if not abs(share) <= ShutterTuning.max_delay_share or not len(known):  # not a number neither
            return frame
        T_color_depth = se3_exp(share * se3_log(self.motion))
        if largest_shift(T_color_depth, frame.camera, float(np.median(known))) < ShutterTuning.min_shift_pixels:
            return frame
        self.T_color_depth = T_color_depth
        return replace(frame, depth=moved_depth(frame.depth, frame.camera, T_color_depth), depth_delay=0.0)

    def judge(
        self, frame: Frame, result: TrackingResult, noise: DepthNoise | None
    ) -> tuple[Frame, TrackingResult]:  # fmt: skip
        """The same; the depth camera's motion up to this frame is known from now on."""
        self.follow(None if result.status is TrackingStatus.LOST else result.T_world_camera)
        return frame, result

    def follow(self, T_world_camera: np.ndarray | None) -> None:
        """The frame that `clean` was asked about last was located at a pose [4, 4], or not (None)."""
        now = None if T_world_camera is None else T_world_camera @ self.T_color_depth
        self.motion = None
        if now is not None and self.T_world_depth is not None:
            # Of the depth camera, as measured: the poses of colour hang on the motion before, and would swing with it.
            self.motion, self.interval = inverse(self.T_world_depth) @ now, self.time - self.time_before
        self.T_world_depth, self.time_before = now, self.time

    def move(self, T_new_old: np.ndarray) -> None:
        """The world about the camera was moved by a correction [4, 4]."""
        if self.T_world_depth is not None:
            self.T_world_depth = T_new_old @ self.T_world_depth
