# SPDX-License-Identifier: Apache-2.0
"""Settings of the occupancy map."""

from __future__ import annotations

import math

import numpy as np

from ggslam.system.settings import Conflict, setting, settings_class, tuning_class


def log_odds(probability: float) -> float:
    """log(p / (1 - p)), rounded to float32 as OctoMap keeps it."""
    return float(np.float32(math.log(probability / (1.0 - probability))))


@tuning_class(frozen=True)
class OccupancyTuning:
    """Numbers of an occupancy map."""

    probability_hit: float = setting(0.7, 0.501, 0.999)
    """Occupancy of a voxel that contains a point, from one scan alone."""
    probability_miss: float = setting(0.4, 0.001, 0.499)
    """Occupancy of a voxel that a ray passes, from one scan alone."""
    probability_minimum: float = setting(0.1192, 0.001, 0.499)
    """Lower bound of a voxel's occupancy, so that changes show within a few scans."""
    probability_maximum: float = setting(0.971, 0.501, 0.999)
    """Upper bound of a voxel's occupancy, so that changes show within a few scans."""
    quantize: bool = True
    """Cast one ray per occupied voxel instead of one per point."""
    most_hits: int = setting(1, 1, 1000)
    """With `quantize`, a voxel is hit in one scan as many times as points lie in it, but no more than this many times;
    1: once, as when OctoMap inserts a scan."""
    last_voxel: bool = True
    """Rays cut at the range free the voxel they end in; false as in OctoMap."""


@settings_class(frozen=True)
class OccupancySettings(OccupancyTuning):
    """How a scan updates the occupancy map. The probabilities are OctoMap's (Hornung et al., "OctoMap", Autonomous
    Robots 2013)."""

    probability_occupied: float = setting(0.5, 0.001, 0.999)
    """A voxel counts as occupied from this probability on."""

    def __post_init__(self) -> None:
        if not self.probability_minimum <= self.probability_occupied <= self.probability_maximum:
            raise Conflict(
                "probability_occupied",
                f"expected {self.probability_minimum:g} to {self.probability_maximum:g} (the clamping thresholds), "
                f"found {self.probability_occupied}",
            )

        if self.most_hits > 1 and not self.quantize:
            raise Conflict("most_hits", f"needs quantize, found {self.most_hits} without it")

    @classmethod
    def with_raised_odds(cls) -> OccupancySettings:
        """Hit 0.85 and miss 0.3, about twice OctoMap's log-odds.

        In a map that is updated point by point the many rays of a voxel add up within one scan. Here one ray stands
        for all of them and counts once, so it must say more if the map is to be as sure after as few scans. OctoMap's
        own insertion of whole scans counts a voxel once as well: the defaults agree with it a little better
        (scripts/benchmarks/bench_occupancy.py prints both), the raised values follow a change in fewer scans.
        """
        return cls(probability_hit=0.85, probability_miss=0.3)

    @property
    def threshold(self) -> float:
        """Log-odds from which a voxel is occupied."""
        return log_odds(self.probability_occupied)

    def scans_until_free(self) -> int:
        """Scans that must see through a voxel, however sure it was occupied, before the map calls it free."""
        value, scans = np.float32(log_odds(self.probability_maximum)), 0
        low, miss = np.float32(log_odds(self.probability_minimum)), np.float32(log_odds(self.probability_miss))
        while value >= self.threshold and value > low:
            value, scans = max(value + miss, low), scans + 1
        return scans
