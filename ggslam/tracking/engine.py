# SPDX-License-Identifier: Apache-2.0
"""The heavy work of a tracker, on the CPU or a GPU: points of depth images, and alignments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.tracking.gicp import AlignmentResult, GicpTarget, PhotometricPart, align
from ggslam.tracking.points import FramePoints, PointSource, extract_points
from ggslam.tracking.settings import AlignSettings, DepthNoise, PointSettings


class TrackingEngine(Protocol):
    """Extracts points and aligns them."""

    def points(self, depth: np.ndarray, settings: PointSettings, noise: DepthNoise) -> PointSource:
        """Points of a depth image, float32 [H, W] in metres; see `points.extract_points`.

        Raises:
            ValueError: the depth image does not fit the camera.
        """

    def align(
        self, source: PointSource, target: GicpTarget, T_world_camera_guess: np.ndarray, settings: AlignSettings,
        noise: DepthNoise, photometric: PhotometricPart | None = None,
    ) -> AlignmentResult:  # fmt: skip
        """Aligns points that this engine gave; see `gicp.align`."""


@dataclass(frozen=True)
class CpuTrackingEngine:
    """Extracts points and aligns them with the compiled core.

    Attributes:
        camera: of all frames.
        context: threads to work on.
    """

    camera: Camera
    context: NativeContext

    def points(self, depth: np.ndarray, settings: PointSettings, noise: DepthNoise) -> FramePoints:
        """See `TrackingEngine`."""
        return extract_points(depth, self.camera, settings, noise, self.context)

    def align(
        self, source: PointSource, target: GicpTarget, T_world_camera_guess: np.ndarray, settings: AlignSettings,
        noise: DepthNoise, photometric: PhotometricPart | None = None,
    ) -> AlignmentResult:  # fmt: skip
        """See `TrackingEngine`."""
        return align(source.read(), target, T_world_camera_guess, settings, noise, self.context, photometric)
