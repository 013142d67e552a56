# SPDX-License-Identifier: Apache-2.0
"""What moves in the frames of a run, kept out of tracking, map and places."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ggslam.movers.detector import MoverDetector
from ggslam.movers.settings import MoverSettings
from ggslam.scene.frame import Frame
from ggslam.tracking.points import DeferredPoints, FramePoints, PointSource
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

DOUBTFUL = (TrackingStatus.LOST, TrackingStatus.DOUBTED)
"""Where frames are that nothing is said of: their poses may be wrong."""


class RunMovers:
    """Finds movers in each located frame, if the settings want it; else frames and results stay as they are.

    Args:
        settings: see there.
        reads_masks: whether frames' masks may be asked for.
    """

    def __init__(self, settings: MoverSettings, reads_masks: bool) -> None:
        self.detector = MoverDetector(settings)
        self._reads_masks = reads_masks

    @property
    def active(self) -> bool:
        """Whether anything is looked for."""
        return self.detector.settings.enabled

    @property
    def mask(self) -> np.ndarray | None:
        """What moves in the frame tracked last, bool [H, W]; None: nothing, as far as is known."""
        return self.detector.mask

    def expect(self, frame: Frame) -> Frame:
        """The frame to locate: without depth where something is expected to move."""
        return self.detector.expect(frame) if self.active else frame

    def look(self, frame: Frame, result: TrackingResult, noise: DepthNoise | None) -> TrackingResult:
        """Finds what moves in a frame that was located; returns the result without points of it."""
        if not self.active:
            return result
        noise = noise or DepthNoise()
        constant, square = np.float32(noise.constant), np.float32(noise.square)
        known = result.status not in DOUBTFUL
        shown = frame if self._reads_masks else replace(frame, mask=None, mask_loader=None)
        self.detector.look(shown, result.T_world_camera if known else None, lambda z: constant + square * z * z)
        mask = self.detector.mask
        return result if mask is None else replace(result, points=_without(result.points, mask))

    def clean(self, frame: Frame) -> Frame:
        """The frame that `look` saw last without depth where something moves, which `Frame.moving` tells."""
        return self.detector.clean(frame) if self.active else frame

    def move(self, T_new_old: np.ndarray) -> None:
        """Follows a correction [4, 4] of the world about the camera."""
        self.detector.move(T_new_old)


def _without(points: PointSource, mask: np.ndarray) -> DeferredPoints:
    """Points of a frame but those on a mask bool [H, W]."""

    def choose() -> FramePoints:
        read = points.read()
        stays = ~mask[read.pixels[:, 1], read.pixels[:, 0]]
        depths = None if read.depths is None else read.depths[stays]
        arrays = (read.points, read.normals, read.covariances, read.pixels, read.weights)
        return FramePoints(*(array[stays] for array in arrays), depths)

    return DeferredPoints(choose, points.median_depth)
