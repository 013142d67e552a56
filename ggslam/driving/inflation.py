# SPDX-License-Identifier: Apache-2.0
"""Costs of driving near obstacles, as nav2's inflation layer gives them: 254 in an obstacle, 253 where the robot would
touch one, then falling off with the distance, 255 where nothing is known."""

from __future__ import annotations

from typing import Final

import numpy as np

from ggslam.driving.bands import BandMap
from ggslam.errors import ConfigError
from ggslam.system.settings import setting, settings_class

UNKNOWN_COST: Final = 255
"""NO_INFORMATION of nav2."""
LETHAL_COST: Final = 254
"""LETHAL_OBSTACLE of nav2: an obstacle is in the cell."""
INSCRIBED_COST: Final = 253
"""INSCRIBED_INFLATED_OBSTACLE of nav2: a robot whose centre is in the cell touches an obstacle."""


@settings_class(frozen=True)
class Inflation:
    """How costs fall off, with the names and defaults of nav2's inflation layer."""

    inflation_radius: float = setting(0.55, 0, 100, "m")
    """Distance from an obstacle up to which cells cost something."""
    cost_scaling_factor: float = setting(10.0, 0, 1000)
    """How fast costs fall off: by a factor of e in the inverse of this many metres."""


def parse_inflation(text: str) -> Inflation:
    """Inflation as the command line writes it: "RADIUS,FACTOR".

    Raises:
        ConfigError: the text says something else, or numbers out of range.
    """
    try:
        radius, factor = (float(word) for word in text.split(","))
    except ValueError:
        raise ConfigError(f'inflation: expected "RADIUS,FACTOR" like "0.55,10", found {text!r}') from None
    return Inflation(radius, factor)


def inflated_cost(band: BandMap, inscribed_radius: float, inflation: Inflation | None = None) -> np.ndarray:
    """The cost of each cell, uint8 [H, W].

    Distances are those of the band, from the cell's centre to the nearest surface; nav2 itself measures between centres
    of cells, which may be up to 0.7 cells more. As in nav2, a cell of which nothing is known stays unknown, unless the
    robot would touch an obstacle in it.

    Args:
        band: of the robot.
        inscribed_radius: of the largest circle in the robot's footprint, metres; of a round robot its radius.
        inflation: how costs fall off.
    """
    inflation = inflation or Inflation()
    distance = band.distance  # compared in its own precision: a distance of 0.18 is not more than a radius of 0.18
    fall_off = np.exp(-inflation.cost_scaling_factor * np.maximum(distance.astype(float) - inscribed_radius, 0))
    cost = np.where(distance <= inflation.inflation_radius, ((INSCRIBED_COST - 1) * fall_off).astype(np.uint8), 0)
    cost = np.where(band.free, cost, UNKNOWN_COST)
    cost = np.where(distance <= inscribed_radius, INSCRIBED_COST, cost)
    return np.where(band.occupied, LETHAL_COST, cost).astype(np.uint8)
