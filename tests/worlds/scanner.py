# SPDX-License-Identifier: Apache-2.0
"""A spinning LiDAR in a generated world."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ggslam.system.settings import setting, settings_class
from worlds.world import World, cast_rays


@dataclass(frozen=True)
class Scan:
    """One turn of the scanner.

    Attributes:
        points: float32 [n, 3], metres in the sensor's frame: x forward, y left, z up.
        rings, columns: int32 [n], which ray each point is on; rings count from the lowest, columns from behind the
            sensor counter-clockwise, as the tests' `LidarFeatures` has them.
        tested: pairs of a ray and a box that were tested.
    """

    points: np.ndarray
    rings: np.ndarray
    columns: np.ndarray
    tested: int

    def __len__(self) -> int:
        return len(self.points)


@settings_class(frozen=True)
class Scanner:
    """The sensor. It stands still during a turn.

    Raises:
        ConfigError: a number out of its range.
    """

    rings: int = setting(16, 1, 1024)
    """Rays above one another, evenly spread in elevation."""
    columns: int = setting(900, 4, 65536)
    """Directions of a turn."""
    lowest_deg: float = setting(-22.5, -89, 89, "deg")
    """Elevation of the lowest ring."""
    highest_deg: float = setting(22.5, -89, 89, "deg")
    """Elevation of the highest ring."""
    nearest: float = setting(0.3, 0, 1e3, "m")
    """Nearer surfaces are not measured."""
    farthest: float = setting(30.0, 0, 1e3, "m")
    """Farther surfaces are not measured."""
    noise: float = setting(0.02, 0, 10, "m")
    """Standard deviation of a range."""

    @cached_property
    def directions(self) -> np.ndarray:
        """Unit vectors of the rays in the sensor's frame, float64 [rings columns, 3], ring by ring."""
        elevation = np.radians(np.linspace(self.lowest_deg, self.highest_deg, self.rings))[:, None]
        azimuth = ((np.arange(self.columns) + 0.5) / self.columns * 2 - 1)[None] * np.pi
        parts = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
        return np.stack(np.broadcast_arrays(*parts), -1).reshape(-1, 3)

    def scan(self, world: World, T_world_sensor: np.ndarray, seed: int) -> Scan:
        """One scan from `T_world_sensor` [4, 4]; the seed is that of the noise."""
        directions = self.directions @ T_world_sensor[:3, :3].T
        origins = np.broadcast_to(T_world_sensor[:3, 3], directions.shape)
        hits = cast_rays(world, origins, directions, self.farthest)
        rng = np.random.default_rng([seed, 8])
        measured = hits.distance + self.noise * rng.standard_normal(len(directions))
        seen = np.nonzero((measured > self.nearest) & (measured <= self.farthest))[0]
        points = (self.directions[seen] * measured[seen, None]).astype(np.float32)
        ring, column = np.divmod(seen.astype(np.int32), np.int32(self.columns))
        return Scan(points, ring, column, hits.tested)
