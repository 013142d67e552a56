# SPDX-License-Identifier: Apache-2.0
"""Estimates the noise of the depth camera from tracking residuals.

Errors that neighbouring pixels share are not seen in one image: depth of a phone is smooth, and wrong by a centimetre.
They show where a frame is laid onto the surface that frames before have measured.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from statistics import median
from typing import Final

import numpy as np

from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning
from ggslam.tracking.gicp import MatchedMedians, PointMatches
from ggslam.tracking.points import FramePoints
from ggslam.tracking.settings import DepthNoise


class ResidualNoiseTuning(Tuning):
    """Measurement of depth noise on tracking residuals."""

    early_stride = 2
    """One frame in this many is measured at the start of a run."""
    early_frames = 24
    """Frames of that start."""
    late_stride = 16
    """One frame in this many is measured later."""
    latest = 12
    """Latest measurements that count."""
    min_points = 100
    """Fewest matched points of a measurement."""
    min_measurements = 4
    """Fewest measurements that noise is estimated from."""
    max_factor = 2.5
    """Ratio of residuals to the expected noise from which the expected noise is raised."""
    surface_sigma_m = 1e-3
    """Standard deviation, in metres, of exact points from a surface gathered in voxels."""
    room_depth_m = 1.25
    """Depth, in metres, below which that deviation shrinks: closer scenes have smaller voxels."""


_MEDIAN_OF_NORMAL: Final = 0.6745
"""Median of the absolute value of a standard normal variable."""


@savable(not_saved="sigma", after="measure")
@dataclass
class ResidualNoise:
    """Compares a noise model with the residuals of tracking, frame by frame.

    Attributes:
        residuals: of the latest frames looked at: median depth, and robust standard deviation of the distances of the
            points to the surface, metres.
        frames: seen so far.
        hidden: how many times as large the noise is taken to be as at first.
        sigma: robust standard deviation in metres of the distances in the latest looks; None: too few so far.
    """

    residuals: list[tuple[float, float]] = field(default_factory=list)
    frames: int = 0
    hidden: float = 1.0
    sigma: float | None = None

    def measure(self) -> None:
        """Makes `sigma`, of residuals that were given."""
        enough = len(self.residuals) >= ResidualNoiseTuning.min_measurements
        self.sigma = median([sigma for _, sigma in self.residuals]) if enough else None

    def due(self) -> bool:
        """Whether the next frame is looked at; counts it."""
        due = self.will_be_due()
        self.frames += 1
        return due

    def will_be_due(self) -> bool:
        """Whether the next frame is looked at."""
        frame = self.frames + 1
        early = frame <= ResidualNoiseTuning.early_frames
        return frame % (ResidualNoiseTuning.early_stride if early else ResidualNoiseTuning.late_stride) == 0

    def observe(self, points: FramePoints, squared_distances: np.ndarray, noise: DepthNoise) -> DepthNoise:
        """The noise that agrees with the residuals so far: the one given, or a larger one of the same shape.

        Args:
            points: of a frame that was located.
            squared_distances: of each to the surface, square metres, infinite without a match.
            noise: as known so far.
        """
        matches = PointMatches(np.empty(0, np.int32), squared_distances)
        return self.observe_medians(matches.medians(points), noise)

    def observe_medians(self, found: MatchedMedians, noise: DepthNoise) -> DepthNoise:
        """The same, of the medians of such a frame."""
        if found.count < ResidualNoiseTuning.min_points:
            return noise
        sigma = float(np.sqrt(np.float32(found.squared_distance))) / _MEDIAN_OF_NORMAL
        self.residuals = [*self.residuals[1 - ResidualNoiseTuning.latest :], (found.depth, sigma)]
        self.measure()
        if self.sigma is None:
            return noise
        z, sigmas = np.array(self.residuals).T
        of_surface = ResidualNoiseTuning.surface_sigma_m * np.minimum(1, z / ResidualNoiseTuning.room_depth_m)
        ratios = sigmas / np.maximum(noise.sigma(z), of_surface)
        if median(ratios.tolist()) < ResidualNoiseTuning.max_factor:
            return noise
        depth, shown = median(z.tolist()), self.sigma
        self.residuals, self.sigma = [], None
        larger = larger_noise(noise, depth, shown)
        self.hidden *= larger.sigma(depth) / noise.sigma(depth)
        return larger


def larger_noise(noise: DepthNoise, depth: float, sigma: float) -> DepthNoise:
    """Noise with the standard deviation `sigma` at a depth, both in metres, half of it growing with depth squared."""
    return DepthNoise(max(noise.constant, 0.5 * sigma), max(noise.square, 0.5 * sigma / depth**2))
