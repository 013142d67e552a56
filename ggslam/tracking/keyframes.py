# SPDX-License-Identifier: Apache-2.0
"""Decides when a frame becomes a keyframe."""

from __future__ import annotations

import enum
from typing import Protocol

import numpy as np

from ggslam.scene.poses import separation
from ggslam.system.array_forms import Pose
from ggslam.system.savable import savable
from ggslam.system.settings import setting, settings_class, tuning_class


class LocatedFrame(Protocol):
    """The part of a `tracker.TrackingResult` that the policy reads."""

    @property
    def T_world_camera(self) -> np.ndarray:
        """Float64 [4, 4]."""

    @property
    def overlap(self) -> float:
        """Share of the frame's points that match the target."""

    @property
    def median_depth_m(self) -> float:
        """Of the frame's points, metres."""


@savable()
class KeyframeKind(enum.Enum):
    """Why a frame is a keyframe."""

    FIRST = "first"
    TRACKING = "tracking"
    """The target no longer covers the frame: the tracker needs its points."""
    MAPPING = "mapping"
    """Enough frames or motion since the last keyframe: the mapper wants the view."""


@tuning_class(frozen=True)
class KeyframeTuning:
    """Numbers of the choice of keyframes."""

    min_gap: int = setting(2, 0, 10**6, "frames")
    """Least distance of such a keyframe to the last one, unless overlap falls below 3/4 of `min_overlap`."""


@settings_class(frozen=True)
class KeyframeSettings(KeyframeTuning):
    """When a frame becomes a keyframe."""

    min_overlap: float = setting(0.8, 0, 1)
    """A frame becomes a keyframe if less than this share of its points matches the surface tracked against."""
    max_gap: int = setting(5, 1, 10**9, "frames")
    """A frame becomes a keyframe at the latest after this many frames without one. 4 instead of 5 gains 0.1 to 0.3 dB
    for a quarter more keyframes."""
    max_translation: float = setting(0.1, 0, 1e9)
    """A frame becomes a keyframe after a motion of this many times the median depth."""
    max_rotation_deg: float = setting(10.0, 0, 360, "deg")
    """A frame becomes a keyframe after a turn by this angle."""


@savable(not_saved="settings")
class KeyframePolicy:
    """Decides frame by frame; remembers the last keyframe.

    Args:
        settings: limits.
    """

    kind: KeyframeKind | None
    _T_world_camera: Pose

    def __init__(self, settings: KeyframeSettings | None = None) -> None:
        self.settings = settings or KeyframeSettings()
        self.kind = None
        """Of the last keyframe."""
        self._frame_index = 0
        self._T_world_camera = np.eye(4)

    def decide(self, frame_index: int, tracked: LocatedFrame) -> bool:
        """Whether the frame becomes a keyframe; if so it is remembered as the last one and `kind` says why.

        Frames that must not become keyframes (held out, lost) are not to be asked about.
        """
        kind = self._kind(frame_index, tracked)
        if kind is None:
            return False
        self.kind, self._frame_index, self._T_world_camera = kind, frame_index, tracked.T_world_camera.copy()
        return True

    def begin_again(self) -> None:
        """The camera is elsewhere: the next frame asked about becomes a keyframe."""
        self.kind = None

    def move(self, T_new_old: np.ndarray) -> None:
        """The world about the last keyframe was moved by a correction [4, 4]."""
        self._T_world_camera = T_new_old @ self._T_world_camera

    def _kind(self, frame_index: int, tracked: LocatedFrame) -> KeyframeKind | None:
        s = self.settings
        if self.kind is None:
            return KeyframeKind.FIRST
        gap = frame_index - self._frame_index
        if tracked.overlap < (s.min_overlap if gap >= s.min_gap else 0.75 * s.min_overlap):
            return KeyframeKind.TRACKING
        translation, rotation = separation(self._T_world_camera, tracked.T_world_camera)
        moved = translation > s.max_translation * max(tracked.median_depth_m, 1e-3) or rotation > s.max_rotation_deg
        return KeyframeKind.MAPPING if gap >= s.max_gap or moved else None
