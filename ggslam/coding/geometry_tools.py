# SPDX-License-Identifier: Apache-2.0
"""Which tools of geometry coding a cloud gets: one parameter set for all slices, chosen before the first is coded.

The reference decoder takes the first set of a stream for all slices, so there is only one.
"""

from __future__ import annotations

import numpy as np

from ggslam.coding.geometry_syntax import GeometryParameters
from ggslam.coding.grid_points import GridPoints
from ggslam.coding.settings import CodecSettings

DENSE_POINTS_PER_CUBE = 1.5
"""Occupied voxels per occupied cube of 4 x 4 x 4 above which neighbours give useful contexts."""
_SMALL = 1 << 16
_ONE_CUBE_IN = 64
_CUBE_MASK = np.uint64(sum((((1 << 21) - 1) & ~3) << (21 * axis) for axis in range(3)))


class DensitySample:
    """Counts occupied voxels and cubes of a cloud that may come in blocks.

    Args:
        count: points of the whole cloud.
    """

    def __init__(self, count: int) -> None:
        self._one_in = 1 if count <= _SMALL else _ONE_CUBE_IN
        self._codes: list[np.ndarray] = []

    def add(self, block: GridPoints) -> None:
        """Notes some of the points of a block."""
        self._codes.append(block.sample_cubes(self._one_in))

    @property
    def voxels_per_cube(self) -> float:
        """Occupied voxels per occupied cube of 4 x 4 x 4, about; 1 for a cloud without points in the sample."""
        voxels = np.unique(np.concatenate(self._codes))
        return len(voxels) / max(1, len(np.unique(voxels & _CUBE_MASK)))


def geometry_parameters(settings: CodecSettings, sample: DensitySample) -> GeometryParameters:
    """The parameter set of a stream."""
    boundary = settings.neighbour_boundary
    if boundary is None:
        boundary = 8 if sample.voxels_per_cube > DENSE_POINTS_PER_CUBE else 0
    near = boundary > 0
    return GeometryParameters(
        settings.duplicates == "merge", boundary, near and settings.adjacent_child,
        settings.intra_prediction_size if near else 0,
    )  # fmt: skip
