# SPDX-License-Identifier: Apache-2.0
"""Poses of all frames, stored relative to keyframes, so that they follow loop closures and refined poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from ggslam.mapping.keyframe import Keyframe
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.slam.result import TrackedFrame
from ggslam.system.array_forms import Pose, check_indices
from ggslam.system.savable import savable
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

_LATEST: Final = 64
"""Keyframes whose poses are remembered: more than ever wait for the mapper."""
_NAMES = {status: status.value for status in TrackingStatus}  # asked for with every frame


@savable(not_saved="_T_anchor_world _latest", growing="frames", check="check", after="_invert_anchor")
class FramePoses:
    """Poses of the frames so far."""

    frames: list[TrackedFrame]
    _T_world_anchor: Pose

    def __init__(self) -> None:
        self.frames = []
        self.keyframes_made = 0
        """Keyframes so far, those included that still wait for the mapper."""
        self._anchor, self._T_world_anchor = -1, np.eye(4)  # number of a keyframe, its pose as tracked
        self._latest: dict[int, np.ndarray] = {}  # poses as tracked, by number
        self._invert_anchor()

    def check(self) -> None:
        """Raises FormatError if a frame hangs on a keyframe that is not there: it may come from a file."""
        check_indices("frames", (frame.keyframe for frame in self.frames), max(1, self.keyframes_made))
        check_indices("the frame's keyframe", [self._anchor + 1], self.keyframes_made + 1)

    def add_keyframe(self, T_world_camera: np.ndarray) -> None:
        """From now on poses are remembered relative to this keyframe, the newest."""
        self.anchor_to(self.keyframes_made, T_world_camera)
        self._latest[self.keyframes_made] = self._T_world_anchor
        self._latest.pop(self.keyframes_made - _LATEST, None)
        self.keyframes_made += 1

    def anchor_to(self, keyframe: int, T_world_camera: np.ndarray) -> None:
        """From now on poses are remembered relative to a keyframe with the pose [4, 4]."""
        self._anchor, self._T_world_anchor = keyframe, T_world_camera.copy()
        self._invert_anchor()

    @property
    def anchor(self) -> tuple[int, np.ndarray]:
        """The keyframe that poses are remembered relative to now, and its pose [4, 4] as tracked."""
        return max(0, self._anchor), self._T_world_anchor

    def move(self, T_new_old: np.ndarray) -> None:
        """The world about the camera was moved by a correction [4, 4]."""
        self._T_world_anchor = T_new_old @ self._T_world_anchor
        self._latest = {number: T_new_old @ T for number, T in self._latest.items()}
        self._invert_anchor()

    def _invert_anchor(self) -> None:
        self._T_anchor_world = inverse(self._T_world_anchor)

    def add(self, frame: Frame, tracking: TrackingResult) -> None:
        """Notes the pose of a frame."""
        T_keyframe_camera = self._T_anchor_world @ tracking.T_world_camera
        self.frames.append(
            TrackedFrame(
                frame.index, frame.source_index, frame.timestamp, max(0, self._anchor), T_keyframe_camera,
                tracking.overlap, tracking.rmse_m, _NAMES[tracking.status], tracking.reason,
            )
        )  # fmt: skip

    def locate_last(self, keyframe: int, T_keyframe_camera: Sequence[np.ndarray]) -> None:
        """The last frames, which were lost, have these poses [4, 4] relative to a keyframe that came after them."""
        count, reason = len(T_keyframe_camera), "from the frame with which a part of the map begins"
        located = [
            replace(
                frame, keyframe=keyframe, T_keyframe_camera=T, status=TrackingStatus.RECOVERED.value, reason=reason
            ) for frame, T in zip(self.frames[len(self.frames) - count :], T_keyframe_camera, strict=True)
        ]  # fmt: skip
        self.frames = [*self.frames[: len(self.frames) - count], *located]  # checkpoints know a list that only grows

    def leave_missing(self, keyframes: Sequence[Keyframe]) -> None:
        """For the end: frames that hang on keyframes that an error has kept from these hang on the last of these."""
        last = len(keyframes) - 1
        if not 0 <= last < self.keyframes_made - 1:
            return
        T_last_world = inverse(keyframes[last].T_world_camera)
        T_last = {number: T_last_world @ T for number, T in self._latest.items() if number > last}
        self.frames = [
            replace(frame, keyframe=last, T_keyframe_camera=T_last[frame.keyframe] @ frame.T_keyframe_camera)
            if frame.keyframe in T_last else frame for frame in self.frames
        ]  # fmt: skip
        self.keyframes_made = last + 1
        if self._anchor > last:
            self.anchor_to(last, keyframes[last].T_world_camera)

    def as_tracked(self, frame: TrackedFrame) -> np.ndarray:
        """T_world_camera [4, 4] of a frame that was just added as tracked."""
        return self._T_world_anchor @ frame.T_keyframe_camera

    def pose_of(self, frame: TrackedFrame, keyframes: Sequence[Keyframe]) -> np.ndarray:
        """T_world_camera [4, 4] of a frame that was not lost, as far as is known by now.

        Args:
            frame: one of `frames`.
            keyframes: that the mapper has taken in.
        """
        if frame.keyframe < len(keyframes):
            return keyframes[frame.keyframe].T_world_camera @ frame.T_keyframe_camera
        return self._T_world_anchor @ frame.T_keyframe_camera
