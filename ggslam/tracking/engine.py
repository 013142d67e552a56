# SPDX-License-Identifier: Apache-2.0
"""The heavy work of a tracker, on the CPU or a GPU: points of depth images, and alignments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ggslam.features.orb import FeatureView
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.tracking.gicp import AlignmentResult, GicpTarget, PhotometricPart, PhotometricSource, align
from ggslam.tracking.points import FramePoints, PointSource, extract_points
from ggslam.tracking.settings import AlignSettings, DepthNoise, PhotometricSettings, PointSettings


class GreyMaker(Protocol):
    """Makes photometric parts from the images of frames."""

    def part(
        self, view: FeatureView, reference: FeatureView, settings: PhotometricSettings, shrink: int, least: int
    ) -> PhotometricSource | None:
        """Of a frame, to be compared with an earlier one; None: it is known to have not enough texture.

        Args:
            view: the frame.
            reference: the earlier one, where it was located.
            shrink: by how much images are reduced.
            least: fewest textured points.
        """


class TrackingEngine(Protocol):
    """Extracts points and aligns them."""

    @property
    def greys(self) -> GreyMaker | None:
        """Makes the photometric parts of alignments; None: the caller does."""

    def points(self, depth: np.ndarray, settings: PointSettings, noise: DepthNoise) -> PointSource:
        """Points of a depth image, float32 [H, W] in metres; see `points.extract_points`.

        Raises:
            ValueError: the depth image does not fit the camera.
        """

    def align(
        self, source: PointSource, target: GicpTarget, T_world_camera_guess: np.ndarray, settings: AlignSettings,
        noise: DepthNoise, photometric: PhotometricSource | None = None,
    ) -> AlignmentResult:  # fmt: skip
        """Aligns points that this engine gave; see `gicp.align`."""

    def expect_target(self, target: GicpTarget) -> None:
        """See `Tracker.expect_target`."""


@dataclass(frozen=True)
class CpuTrackingEngine:
    """Extracts points and aligns them with the compiled core.

    Attributes:
        camera: of all frames.
        context: threads to work on.
    """

    camera: Camera
    context: NativeContext

    @property
    def greys(self) -> None:
        """See `TrackingEngine`."""
        return None

    def points(self, depth: np.ndarray, settings: PointSettings, noise: DepthNoise) -> FramePoints:
        """See `TrackingEngine`."""
        return extract_points(depth, self.camera, settings, noise, self.context)

    def align(
        self, source: PointSource, target: GicpTarget, T_world_camera_guess: np.ndarray, settings: AlignSettings,
        noise: DepthNoise, photometric: PhotometricSource | None = None,
    ) -> AlignmentResult:  # fmt: skip
        """See `TrackingEngine`."""
        assert photometric is None or isinstance(photometric, PhotometricPart)
        return align(source.read(), target, T_world_camera_guess, settings, noise, self.context, photometric)

    def expect_target(self, target: GicpTarget) -> None:
        """Nothing: it is where it is used."""
