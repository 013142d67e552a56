# SPDX-License-Identifier: Apache-2.0
"""What tracking says of the depth camera's noise.

Errors that neighbouring pixels share are not seen in one image: depth of a phone is smooth, and wrong by a centimetre.
They show where a frame is laid onto the surface that frames before have measured.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ggslam.system.savable import savable
from ggslam.tracking.points import FramePoints
from ggslam.tracking.settings import DepthNoise

EVERY, BEGINNING, LATER = 2, 24, 16
"""Every so many frames are looked at, up to a frame, and every so many later: on a GPU a look waits for the device."""
LATEST, FEWEST = 12, 4
"""So many looks count, the latest ones, and so many there have to be."""
DISHONEST = 2.5
"""The noise is taken to be larger when residuals are this many times as large as it, and as the surface's own."""
SURFACE_SIGMA = 1e-3
"""Metres by which points of an exact camera miss a surface gathered in voxels."""
ROOM_DEPTH = 1.25
"""Metres; voxels of nearer scenes are smaller, and so is what they cost."""
_MEDIAN_OF_NORMAL = 0.6745


@savable()
@dataclass
class ResidualNoise:
    """Holds a noise model to the residuals of tracking, frame after frame.

    Attributes:
        residuals: of the latest frames looked at: median depth, and robust standard deviation of the distances of the
            points to the surface, metres.
        frames: seen so far.
        hidden: how many times as large the noise is taken to be as at first.
    """

    residuals: list[tuple[float, float]] = field(default_factory=list)
    frames: int = 0
    hidden: float = 1.0

    @property
    def sigma(self) -> float | None:
        """Robust standard deviation in metres of the distances in the latest looks; None: too few so far."""
        return float(np.median([sigma for _, sigma in self.residuals])) if len(self.residuals) >= FEWEST else None

    def due(self) -> bool:
        """Whether the next frame is looked at; counts it."""
        self.frames += 1
        return self.frames % (EVERY if self.frames <= BEGINNING else LATER) == 0

    def observe(self, points: FramePoints, squared_distances: np.ndarray, noise: DepthNoise) -> DepthNoise:
        """The noise that agrees with the residuals so far: the one given, or a larger one of the same shape.

        Args:
            points: of a frame that was located.
            squared_distances: of each to the surface, square metres, infinite without a match.
            noise: as known so far.
        """
        matched = np.isfinite(squared_distances)
        if matched.sum() < 100:
            return noise
        sigma = float(np.sqrt(np.median(squared_distances[matched]))) / _MEDIAN_OF_NORMAL
        self.residuals = [*self.residuals[1 - LATEST :], (float(np.median(points.z[matched])), sigma)]
        if len(self.residuals) < FEWEST:
            return noise
        ratios = [sigma / max(noise.sigma(z), SURFACE_SIGMA * min(1, z / ROOM_DEPTH)) for z, sigma in self.residuals]
        factor = float(np.median(ratios))
        if factor < DISHONEST:
            return noise
        depth, found = (float(np.median(values)) for values in zip(*self.residuals, strict=True))
        self.residuals = []
        larger = larger_noise(noise, depth, found)
        self.hidden *= larger.sigma(depth) / noise.sigma(depth)
        return larger


def larger_noise(noise: DepthNoise, depth: float, sigma: float) -> DepthNoise:
    """Noise with the standard deviation `sigma` at a depth, both in metres, half of it growing with depth squared."""
    return DepthNoise(max(noise.constant, 0.5 * sigma), max(noise.square, 0.5 * sigma / depth**2))
