# SPDX-License-Identifier: Apache-2.0
"""The points of a scan, quantised on the key grid of OctoMap: one voxel centre for all the points of a voxel.

The grid must be the map's own. Its origin is a corner of a voxel (key 32768), so a coarser grid, or one around voxel
centres, would put points into voxels that the map tells apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from ggslam.errors import ConfigError
from ggslam.native.loader import NativeContext, load_library
from ggslam.system.tuning import Tuning
from ggslam.volumes.occupancy_arrays import contiguous_points

KEY_OFFSET: Final = 32768
"""OctoMap's key of the voxel whose lower corner is the origin of the world."""


class KeyGridTuning(Tuning):
    """Limits of the key grid."""

    resolution_range = (1e-4, 1e3)
    """Smallest and largest edge of a voxel, in metres."""


@dataclass(frozen=True)
class QuantizedPoints:
    """The distinct voxels of a scan, neighbours in space mostly side by side.

    Attributes:
        resolution: edge of a voxel, metres.
        keys: uint16 [M, 3].
        counts: int32 [M], points in each voxel; None when they were not asked for.
    """

    resolution: float
    keys: np.ndarray
    counts: np.ndarray | None = None

    def centers(self) -> np.ndarray:
        """Centres of the voxels, float32 [M, 3], metres."""
        return key_centers(self.keys, self.resolution).astype(np.float32)


def quantize(points: np.ndarray, resolution: float, context: NativeContext, count: bool = False) -> QuantizedPoints:
    """The distinct voxels of points (algorithm 1 of the voxel-quantised update), found with a hash of bit blocks.

    Args:
        points: [N, 3] in the map's frame, metres. Those not finite or outside the grid are left out.
        resolution: edge of a voxel of the map, metres.
        count: also tells how many points lie in each voxel.

    Raises:
        ConfigError: impossible resolution.
        ValueError: points of another shape.
    """
    check_resolution(resolution)
    points = contiguous_points(points)
    keys = np.empty((len(points), 3), np.uint16)
    counts = np.empty(len(points), np.int32) if count else None
    number = load_library().ggslam_quantize(
        context.handle,
        resolution,
        points.ctypes.data,
        len(points),
        keys.ctypes.data,
        None if counts is None else counts.ctypes.data,
    )
    return QuantizedPoints(resolution, keys[:number].copy(), None if counts is None else counts[:number].copy())


def key_centers(keys: np.ndarray, resolution: float) -> np.ndarray:
    """Centres of the voxels with these keys [..., 3], float64, metres."""
    return (keys.astype(np.float64) - KEY_OFFSET + 0.5) * resolution


def check_resolution(resolution: float) -> None:
    """Raises ConfigError for an impossible edge of a voxel."""
    low, high = KeyGridTuning.resolution_range
    if not low <= resolution <= high:
        raise ConfigError(f"resolution: expected {low:g} to {high:g} m, found {resolution}")
