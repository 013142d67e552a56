# SPDX-License-Identifier: Apache-2.0
"""How long after a picture was taken its pose is known, and the map knows what it shows."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ggslam.scene.frame import Frame

Since = Literal["stamp", "arrival", "due"]
"""What latency counts from: the time of the picture, where stamps are of this machine's clock; when it came, where they
are not; when a recording's frame was due."""


@dataclass(frozen=True)
class Delays:
    """Median and 95 % of `count` delays, seconds."""

    count: int
    median_s: float
    p95_s: float

    @staticmethod
    def of(seconds: list[float]) -> Delays:
        """Of one or more."""
        median, p95 = np.percentile(seconds, [50, 95])
        return Delays(len(seconds), float(median), float(p95))


class LatencyMeter:
    """Notes delays.

    Args:
        taken: when a frame was taken, by `now`; NaN: not known.
        now: tells the time.
    """

    def __init__(self, taken: Callable[[Frame], float], now: Callable[[], float] = time.time) -> None:
        self._taken, self._now = taken, now
        self._pose: list[float] = []
        self._map: list[float] = []

    def pose_known(self, frame: Frame) -> None:
        """The step of a frame is done."""
        self._note(self._pose, frame)

    def in_map(self, frame: Frame) -> None:
        """A keyframe is in the map; may be called from another thread."""
        self._note(self._map, frame)

    def _note(self, delays: list[float], frame: Frame) -> None:
        delay = self._now() - self._taken(frame)
        if math.isfinite(delay):
            delays.append(delay)

    def pose(self) -> Delays | None:
        """From taking to the pose; None: no frame had one."""
        return Delays.of(self._pose) if self._pose else None

    def map(self) -> Delays | None:
        """From taking to the map, of keyframes; None: there was none."""
        return Delays.of(self._map) if self._map else None
