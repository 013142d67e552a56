# SPDX-License-Identifier: Apache-2.0
"""Chooses old keyframes to compare with while the camera stays in view of its map.

What the tracker aligns to holds old and new keyframes together, so that drift between them is not seen: the camera
follows whatever lies nearest. It shows when a frame is compared with the old keyframes alone. How far a keyframe may
have drifted from an old one goes with the way the camera went between them, less what was compared on it before: a
comparison that found nothing wrong ties its two ends together.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ggslam.scene.poses import so3_log
from ggslam.system.array_forms import Form
from ggslam.system.savable import savable
from ggslam.system.settings import setting, settings_class, tuning_class


@tuning_class(frozen=True)
class RevisitTuning:
    """Numbers of the comparison of keyframes with older active ones."""

    gap: int = setting(15, 1, 10**6, "keyframes")
    """Least distance in keyframes to an older one."""
    least_way: float = setting(1.0, 0, 1e6)
    """Least way of the camera since the last comparison, as a multiple of the median depth; a turn by one radian counts
    as 1 m."""
    near: float = setting(0.6, 0, 1e3)
    """Both cameras and both view centres lie within this many times the mean of the median depths."""
    turned: float = setting(40.0, 0, 180, "deg")
    """Largest angle between the viewing directions."""
    min_witnesses: int = setting(8, 3, 10**5)
    """Matches that must agree with an expected pose."""


@settings_class(frozen=True)
class RevisitSettings(RevisitTuning):
    """When keyframes are compared with older ones that are still tracked against."""

    enabled: bool = setting(True)
    """Compare keyframes with older ones that are still tracked against, and correct the drift between them."""


@savable(not_saved="settings")
class Revisits:
    """Remembers how far the camera went, and which keyframes were compared.

    Args:
        settings: limits.
    """

    _way: Annotated[np.ndarray, Form("f8", "n", finite=True)]
    _tied_at: Annotated[np.ndarray, Form("f8", "n")]

    def __init__(self, settings: RevisitSettings | None = None) -> None:
        self.settings = settings or RevisitSettings()
        self._way = np.zeros(0)
        """How far the camera had gone at each keyframe, metres."""
        self._tied_at = np.zeros(0)
        """The same at the newest keyframe that each was compared with as the older one; -inf: with none."""
        self._rests_until = 0

    def __len__(self) -> int:
        """Keyframes so far."""
        return len(self._way)

    def add(self, T_before_new: np.ndarray) -> None:
        """The next keyframe, after a motion [4, 4] since the one before it."""
        turn = float(np.linalg.norm(so3_log(T_before_new[:3, :3])))
        before = self._way[-1] if len(self._way) else 0.0
        self._way = np.append(self._way, before + float(np.linalg.norm(T_before_new[:3, 3])) + turn)
        self._tied_at = np.append(self._tied_at, -np.inf)

    def tie(self, old: int, new: int) -> None:
        """Two keyframes were compared, and lie right to each other now."""
        self._tied_at[old] = max(self._tied_at[old], self._way[new])

    def pause(self) -> None:
        """The newest keyframe was compared in vain, and is not compared again."""
        self._rests_until = len(self._way)

    def candidates(self, median_depth_m: float) -> np.ndarray:
        """Numbers of the keyframes that the newest is worth to be compared with, rising."""
        newest = len(self._way) - 1
        old = newest + 1 - self.settings.gap
        if not self.settings.enabled or newest < self._rests_until or old < 1:
            return np.zeros(0, int)
        way, tied = self._way, self._tied_at
        # The shortest way by one tie: from the keyframe along the recording to the tie's old end, before it or behind
        # it, and from the tie's new end to the newest keyframe.
        before = np.maximum.accumulate(tied + way)[:old] - way[:old]
        behind = np.maximum.accumulate((tied - way)[::-1])[::-1][:old] + way[:old]
        apart = way[newest] - np.maximum(way[:old], np.maximum(before, behind))
        return np.flatnonzero(apart >= self.settings.least_way * median_depth_m)
