# SPDX-License-Identifier: Apache-2.0
"""How many measured points a second volumes take."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ggslam.volumes.maps import VolumeMaps

_NAMES = {"cells": "disk", "tsdf": "TSDF", "esdf": "distance field", "occupancy": "occupancy"}


@dataclass(frozen=True)
class PointRates:
    """Points and the time that they took.

    Attributes:
        points: measured points that were fused.
        seconds: by map ("cells" to disk and back, "tsdf", "esdf", "occupancy"), in all; without reading and tracking.
    """

    points: int
    seconds: dict[str, float]

    @staticmethod
    def of(maps: VolumeMaps) -> PointRates:
        """Of all that was fused; a distance field that is made once at the end counts with that, and one that is
        made cell by cell for files does not."""
        seconds = {name: float(took.sum()) for name, took in maps.times.parts().items() if name in _NAMES}
        if maps.field is not None and "esdf" not in seconds and maps.cell_field is None:
            seconds["esdf"] = maps.times.last_update
        return PointRates(maps.points, seconds)

    def rate(self, *names: str) -> float:
        """Points a second, of some maps together; without names of all."""
        took = sum(self.seconds[name] for name in names or self.seconds)
        return self.points / took if took > 0 else 0.0

    def line(self) -> str:
        """For people."""
        each = ", ".join(f"{_NAMES[name]} {_in_words(self.rate(name))}" for name in self.seconds)
        alone = f" ({each})" if len(self.seconds) > 1 else ""
        return f"{self.points:,} points, {_in_words(self.rate())} points/s{alone}"

    def to_dict(self) -> dict[str, Any]:
        """For volumes.json."""
        return {"count": self.points, "per_s": self.rate(), "per_s_by_map": {n: self.rate(n) for n in self.seconds}}


def _in_words(rate: float) -> str:
    return f"{rate / 1e6:.1f} million" if rate >= 1e6 else f"{rate:,.0f}"
