# SPDX-License-Identifier: Apache-2.0
"""Codes frames between keyframes beside the loop, which would take longer for it than for the rest of a frame."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from ggslam.mapping.between_frames import BetweenFrame, code_frame
from ggslam.scene.frame import Frame
from ggslam.system.tuning import Tuning


class BetweenCoderTuning(Tuning):
    """Coding of frames between keyframes beside the loop."""

    most_ahead = 8
    """Frames that may be on their way. What a run keeps depends on their number, not on how long coding takes."""


class BetweenCoder:
    """A thread that codes frames; they join those kept in their order."""

    def __init__(self) -> None:
        self._thread: ThreadPoolExecutor | None = None
        self._under_way: deque[Future[BetweenFrame]] = deque()

    def add(self, frame: Frame, keyframe: int, T_keyframe_camera: np.ndarray, kept: list[BetweenFrame]) -> None:
        """Starts to code a frame, arguments as of `code_frame`; `kept` gets the one started `most_ahead` frames ago."""
        if self._thread is None:
            self._thread = ThreadPoolExecutor(1, "between frames")
        own = replace(frame, color=frame.color.copy())  # the caller may use its memory for the next frame
        self._under_way.append(self._thread.submit(code_frame, own, keyframe, T_keyframe_camera))
        if len(self._under_way) > BetweenCoderTuning.most_ahead:
            kept.append(self._under_way.popleft().result())

    def finish(self, kept: list[BetweenFrame]) -> None:
        """`kept` gets all that were started."""
        while self._under_way:
            kept.append(self._under_way.popleft().result())
