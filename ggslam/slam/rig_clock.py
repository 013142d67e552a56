# SPDX-License-Identifier: Apache-2.0
"""Motion of a rig between the images of cameras whose shutters do not open together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.scene.poses import inverse, se3_exp, se3_log
from ggslam.system.array_forms import Pose
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class RigClockTuning(Tuning):
    """When images of a rig were taken together."""

    max_interval_s = 0.5
    """Longest time between two instants over which motion is interpolated, in seconds."""
    together_s = 0.002
    """Largest time between images that count as simultaneous, in seconds: a hand moves below 1 mm meanwhile."""


@savable()
@dataclass
class RigClock:
    """Predicts the motion of a rig at the speed between its last two instants.

    Attributes:
        T_world_first: [4, 4], where the rig was at the last instant; None: not known.
        time: of that, seconds.
        motion: [4, 4], from its pose at the instant before to that at the last one; None: not known.
        interval: the time that took, seconds.
    """

    T_world_first: Pose | None = None
    time: float = 0.0
    motion: Pose | None = None
    interval: float = 0.0

    def knows(self, seconds: float) -> bool:
        """Whether `motion_in` can tell the motion in so short a time."""
        return abs(seconds) <= RigClockTuning.together_s or self.motion is not None

    def motion_in(self, seconds: float) -> np.ndarray:
        """T_now_then [4, 4], to the rig's pose now from that so many seconds later; the identity if it is not known."""
        if self.motion is None or abs(seconds) <= 1e-6:
            return np.eye(4)
        return se3_exp(seconds / self.interval * se3_log(self.motion))

    def follow(self, T_world_first: np.ndarray | None, time: float) -> None:
        """The rig was located at a pose [4, 4], or not (None), at the next instant."""
        interval, self.motion = time - self.time, None
        if (
            T_world_first is not None
            and self.T_world_first is not None
            and 0 < interval <= RigClockTuning.max_interval_s
        ):
            self.motion, self.interval = inverse(self.T_world_first) @ T_world_first, interval
        self.T_world_first, self.time = T_world_first, time

    def move(self, T_new_old: np.ndarray) -> None:
        """The world about the rig was moved by a correction [4, 4]."""
        if self.T_world_first is not None:
            self.T_world_first = T_new_old @ self.T_world_first
