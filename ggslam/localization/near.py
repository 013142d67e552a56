# SPDX-License-Identifier: Apache-2.0
"""A rough position of a recording, from a satellite receiver or a person."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.errors import ConfigError
from ggslam.submaps.settings import GridAxes
from ggslam.system.tuning import Tuning


class NearTuning(Tuning):
    """Search around a given position."""

    sigmas = 3.0
    """Radius of the search in standard deviations of the position."""


@dataclass(frozen=True)
class Near:
    """A position with its uncertainty.

    Attributes:
        position: metres in the map's world, (x, y) or (x, y, z); of a map whose grid is "xz", whose y points down, two
            numbers are x and z.
        sigma: standard deviation of each, metres.
    """

    position: tuple[float, ...]
    sigma: float

    def allows(self, positions: np.ndarray, axes: GridAxes, further: float = 0.0) -> np.ndarray:
        """Which of positions [n, 3] are within three standard deviations, or `further` metres beyond, bool [n]; `axes`:
        of the map's grid."""
        spanned = [0, 1, 2] if len(self.position) == 3 else [0, 2] if axes == "xz" else [0, 1]
        reach = NearTuning.sigmas * self.sigma + further
        return np.linalg.norm(positions[:, spanned] - np.array(self.position), axis=1) <= reach

    def __str__(self) -> str:
        return f"within {NearTuning.sigmas * self.sigma:g} m of ({', '.join(f'{value:g}' for value in self.position)})"


def parse_near(text: str) -> Near:
    """Of "x y sigma" or "x y z sigma". Raises ConfigError for anything else."""
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) not in (3, 4) or not np.isfinite(numbers).all() or numbers[-1] <= 0:
        raise ConfigError(f'`near`: expected "x y sigma" or "x y z sigma", metres, sigma above 0, found {text!r}')
    return Near(tuple(numbers[:-1]), numbers[-1])
