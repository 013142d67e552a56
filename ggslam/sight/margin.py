# SPDX-License-Identifier: Apache-2.0
"""The margin between measured depths of one surface."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ggslam.abi.core import SightMargin
from ggslam.system.tuning import Tuning


class MarginTuning(Tuning):
    """Margin between depths of one surface."""

    sigmas = 5.0
    """Standard deviations of the depth noise within which depths belong to one surface. Neighbouring pixels share
    noise, so that three would be too few."""


class Noise(Protocol):
    """The standard deviation of a depth camera at depth z is constant + square z^2, metres."""

    @property
    def constant(self) -> float:
        """Metres, at the camera."""

    @property
    def square(self) -> float:
        """1/m, growth with the squared depth."""


@dataclass(frozen=True)
class Margin:
    """Depths z of one surface differ by at most max(least, share z) + sigmas (constant + square z^2), metres.

    The first term is for errors of poses and of the surfaces of maps, the second for the noise of the depth camera.
    The defaults hold for views whose poses are refined, and for surfaces without noise, as maps render them.

    Attributes:
        least: metres; no surface is better known than this.
        share: of the distance, for errors of rotation.
        sigmas: standard deviations of the noise.
        constant, square: the noise, see `Noise`.
    """

    least: float = 0.02
    share: float = 0.01
    sigmas: float = 0.0
    constant: float = 0.0
    square: float = 0.0

    @staticmethod
    def of(noise: Noise) -> Margin:
        """The margin where depths of a camera with this noise are compared."""
        return Margin(sigmas=MarginTuning.sigmas, constant=noise.constant, square=noise.square)

    @staticmethod
    def usual() -> Margin:
        """The margin of a structured-light camera (Khoshelham and Oude Elberink, Sensors 2012), for depth of which the
        noise is not known yet."""
        return Margin(sigmas=MarginTuning.sigmas, constant=0.0012, square=0.0019)

    def times(self, factor: float) -> Margin:
        """A margin `factor` times as wide."""
        return replace(self, least=factor * self.least, share=factor * self.share, sigmas=factor * self.sigmas)

    def native(self) -> SightMargin:
        """As compiled code takes it."""
        return SightMargin(self.least, self.share, self.sigmas, self.constant, self.square)

    def __call__(self, z: np.ndarray, noise_share: np.ndarray | float = 1.0) -> np.ndarray:
        """Metres at depths z [...] in metres; `noise_share` of the noise is left where means of depth are compared."""
        return np.maximum(self.least, self.share * z) + self.sigmas * noise_share * self.sigma(z)

    def sigma(self, z: np.ndarray) -> np.ndarray:
        """Standard deviation of the depth camera at depths [...] in metres, metres."""
        return self.constant + self.square * z * z
