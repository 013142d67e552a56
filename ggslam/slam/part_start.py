# SPDX-License-Identifier: Apache-2.0
"""Decides when a lost camera that no place matches starts a new part of the map.

Frames that see no surface (a covered lens) or too little of one another (a shaken camera) could not be tracked from one
another either; they begin nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ggslam.native.loader import NativeContext
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, orthonormalize
from ggslam.system.array_forms import Pose
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning
from ggslam.tracking.gicp import AlignmentStatus, GicpTarget, align
from ggslam.tracking.points import FramePoints
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.surface import MeasuredSurface
from ggslam.tracking.tracker import Tracker, TrackingResult, TrackingStatus


class PartStartTuning(Tuning):
    """How a new part of the map starts."""

    max_frames = 8
    """Most frames kept to become keyframes of the new part."""
    distance_depths = 12.5
    """Distance between parts, in units of the largest depth used: 100 m indoors, where float32 resolves 0.01 mm."""


@dataclass(frozen=True)
class PartBeginning:
    """The start of a part.

    Attributes:
        keyframes: of the frames watched before the last; there may be none.
        T_world_camera: [4, 4], of the last.
        T_first_camera: of the frames watched before it, [4, 4] each, in the camera's frame of the first keyframe (of
            the last frame, if there is none).
    """

    keyframes: list[tuple[Frame, TrackingResult]]
    T_world_camera: np.ndarray
    T_first_camera: list[np.ndarray]


@savable(not_saved="target")
@dataclass
class PartStart:
    """Observes lost frames.

    Attributes:
        poses: of the latest frames in a row that can be tracked from one another, in the camera's frame of the first of
            them, [4, 4] each.
        first: index of the first of them.
        since: time of the first of them, seconds.
        reference: number in `poses` and points of the frame that the next one is aligned to.
        before: points of the latest.
        turned: float64 [4, 4], how the image had turned by then since the camera was lost (`CameraMotion.turned`).
        kept: frames of these that may become keyframes, with their numbers in `poses` and their points.
        keyframe: number of the last keyframe that the newest part began with.
        target: what frames are aligned to until that is in.
    """

    poses: list[Pose] = field(default_factory=list)
    first: int = 0
    since: float = 0.0
    reference: tuple[int, FramePoints] | None = None
    before: FramePoints | None = None
    turned: Pose = field(default_factory=lambda: np.eye(4))
    kept: list[tuple[int, Frame, FramePoints]] = field(default_factory=list)
    keyframe: int = -1
    target: GicpTarget | None = None

    def forget(self) -> None:
        """The camera is not lost, or shows nothing that it could be tracked by."""
        self.poses, self.kept, self.reference, self.before = [], [], None, None

    def watch(self, frame: Frame, lost: TrackingResult, tracker: Tracker, context: NativeContext) -> None:
        """A frame was lost, and no place tells where it is."""
        if len(lost.points) < tracker.settings.align.min_matches:
            self.forget()
            return
        points, T = lost.points.read(), self._locate(lost, tracker, context)
        if T is None:
            T, self.poses, self.kept, self.reference = np.eye(4), [], [], (0, points)
            self.first, self.since = frame.index, frame.timestamp
        self.poses.append(T)
        self.before, self.turned = points, tracker.state.motion.turned.copy()

    def is_due(self, frame: Frame, tracker: Tracker) -> bool:
        """Whether a part may begin with this frame, which was watched last."""
        recovery = tracker.settings.recovery
        enough = 0 < recovery.new_part_after <= len(self.poses)
        return enough and not 0 < frame.timestamp - self.since < recovery.new_part_seconds  # 0: there are no times

    def keep(self, frame: Frame, with_mask: bool, gap: int) -> None:
        """The frame that was watched last may become a keyframe; it is kept unless one was so few frames ago, or enough
        are. Its mask is read now, for the recording may be read elsewhere by then."""
        number = len(self.poses) - 1
        if (
            self.before is None
            or len(self.kept) >= PartStartTuning.max_frames
            or (self.kept and number - self.kept[-1][0] < gap)
        ):
            return
        mask = frame.load_mask() if with_mask else None
        self.kept.append((number, replace(frame, mask=mask, mask_loader=None, T_world_camera=None), self.before))

    def begin(
        self, keyframe: int, lost: TrackingResult, surface: MeasuredSurface, T_world_first: np.ndarray,
        context: NativeContext,
    ) -> PartBeginning:  # fmt: skip
        """A part begins with the frames that were watched; frames are aligned to what its keyframes show until they are
        in the surface.

        Args:
            keyframe: number of its first keyframe.
            lost: what tracking said of the frame watched last.
            surface: that keyframes will join.
            T_world_first: where the first of the frames is to be [4, 4].
            context: threads.
        """
        own = MeasuredSurface(surface.settings, context)
        own.finish = surface.finish
        keyframes, reason = [], "a new part of the map begins"
        for number, frame, points in self.kept:
            T = T_world_first @ self.poses[number]
            own.add(points, T)
            keyframes.append((frame, TrackingResult(T, TrackingStatus.FIRST, 1.0, 0.0, reason, points)))
        T_world_last = T_world_first @ self.poses[-1]
        self.keyframe, self.target = keyframe + max(0, len(keyframes) - 1), own.add(lost.points, T_world_last)
        anchor = self.kept[0][0] if self.kept else len(self.poses) - 1
        found = [inverse(self.poses[anchor]) @ T for T in self.poses[:-1]]
        self.forget()
        return PartBeginning(keyframes, T_world_last, found)

    def _locate(self, lost: TrackingResult, tracker: Tracker, context: NativeContext) -> np.ndarray | None:
        """The pose of a lost frame among those watched [4, 4]; None if it cannot be tracked from them."""
        if self.reference is None or self.before is None:
            return None
        guess = self.poses[-1] @ inverse(self.turned) @ tracker.state.motion.turned
        newest = len(self.poses) - 1
        for number, points in (self.reference, (newest, self.before)):
            found = _align_two(lost, points, inverse(self.poses[number]) @ guess, tracker, context)
            if found is not None:
                self.reference = number, points
                return orthonormalize(self.poses[number] @ found)
        return None


def _align_two(
    lost: TrackingResult, earlier: FramePoints, guess: np.ndarray, tracker: Tracker, context: NativeContext
) -> np.ndarray | None:
    """The pose of a frame in the camera's frame of an earlier one [4, 4]; None if too little of it was seen there."""
    settings, noise = tracker.settings, tracker.noise or DepthNoise()
    target = MeasuredSurface(settings.target, context).add(earlier, np.eye(4))
    found = align(lost.points.read(), target, guess, settings.align, noise, context)
    if found.status is AlignmentStatus.LOST or found.overlap < settings.recovery.convincing_overlap:
        return None
    return found.T_world_camera


def pose_apart(T_world_camera: np.ndarray, keyframes: np.ndarray, farthest_m: float) -> np.ndarray:
    """A pose [4, 4] for a new part: as the camera was last known to look, and far above everything mapped so far.

    Args:
        T_world_camera: the last known pose [4, 4].
        keyframes: poses of the keyframes [K, 4, 4].
        farthest_m: depth that is used at most, metres.
    """
    T = T_world_camera.copy()
    highest = min(float(T[1, 3]), float(keyframes[:, 1, 3].min(initial=np.inf)))  # the y axis points down
    T[1, 3] = highest - PartStartTuning.distance_depths * farthest_m
    return T
