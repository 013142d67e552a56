# SPDX-License-Identifier: Apache-2.0
"""Where the sensor found nothing in frames that are keyframes, for volumes that are made anew of these: keyframes keep
depth as whole numbers, which have no infinity."""

from __future__ import annotations

import zlib
from collections.abc import Iterable

import numpy as np

from ggslam.mapping.keyframe import Keyframe
from ggslam.scene.frame import Frame
from ggslam.system.tuning import Tuning


class NoReturnTuning(Tuning):
    """How long pixels without a return are kept."""

    newest_frames = 64
    """Latest frames that may still become keyframes."""


class NoReturns:
    """Masks of frames, packed."""

    def __init__(self) -> None:
        self._packed: dict[int, bytes] = {}
        self._most = 2 * NoReturnTuning.newest_frames

    def note(self, frame: Frame, keyframes: Iterable[Keyframe]) -> None:
        """Keeps a frame's mask, if it has one, and now and then drops those of frames that are none of the keyframes
        and not of the newest."""
        if frame.no_return is None:
            return
        self._packed[frame.index] = zlib.compress(np.packbits(frame.no_return).tobytes(), 1)
        if len(self._packed) > self._most:
            kept = {keyframe.frame_index for keyframe in keyframes} | set(
                list(self._packed)[-NoReturnTuning.newest_frames :]
            )
            self._packed = {index: packed for index, packed in self._packed.items() if index in kept}
            self._most = 2 * len(self._packed) + NoReturnTuning.newest_frames

    def depth_of(self, keyframe: Keyframe) -> np.ndarray:
        """Depth float32 [H, W], metres; +inf where the sensor found nothing."""
        depth, packed = keyframe.depth_m(), self._packed.get(keyframe.frame_index)
        if packed is None:
            return depth
        bits = np.unpackbits(np.frombuffer(zlib.decompress(packed), np.uint8))
        nothing = bits[: depth.size].reshape(depth.shape).astype(bool)
        return np.where(nothing & (depth == 0), np.float32(np.inf), depth)
