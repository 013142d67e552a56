# SPDX-License-Identifier: Apache-2.0
"""Chooses the tools of geometry coding for a cloud: one parameter set for all slices, chosen before the first is coded.

The reference decoder takes the first set of a stream for all slices, so there is only one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Final

import numpy as np

from ggslam.coding.geometry_syntax import ALL_AXES, MAX_DEPTH, GeometryParameters
from ggslam.coding.grid_points import GridPoints
from ggslam.coding.position_quantiser import PositionQuantiser
from ggslam.coding.settings import CodecSettings
from ggslam.coding.slice_coder import SliceCoder
from ggslam.system.tuning import Tuning


class GeometryTuning(Tuning):
    """Which coding tools suit a cloud."""

    dense = 1.5
    """Occupied voxels per occupied cube of 4 x 4 x 4 above which neighbours give useful contexts."""
    planes = 4.0
    """Occupied voxels per cube up to which the planar mode is tried."""
    planes_gain = 0.03
    """Smallest share of the bytes that the planar mode must save."""
    sample = 1 << 14
    """Points that are looked at, about."""
    cube_bits = 6
    """Cubes along the longest side, as a binary logarithm."""


PLANE_THRESHOLDS: Final = (77, 99, 113)
"""Thresholds of the planar mode in MPEG's common test conditions."""


class GeometrySample:
    """Some of the points of a cloud that may come in blocks: those in cubes that a hash chooses.

    Args:
        count: points of the whole cloud.
        size: of its grid, voxels.
        quantiser: of its positions.
    """

    def __init__(self, count: int, size: Sequence[int], quantiser: PositionQuantiser) -> None:
        self._quantiser = quantiser
        self._one_in = 1 << max(0, (count // GeometryTuning.sample).bit_length() - 1)
        self._cube_bits = max(2, (max(size) - 1).bit_length() - GeometryTuning.cube_bits)
        self._codes: list[np.ndarray] = []

    def add(self, block: GridPoints) -> None:
        """Notes the points of a block that belong to the sample."""
        self._codes.append(block.sample_cubes(self._cube_bits, self._one_in))

    @cached_property
    def voxels(self) -> np.ndarray:
        """Occupied voxels of the sample, or steps of its quantiser, int32 [N, 3]."""
        codes, mask = np.unique(np.concatenate(self._codes)).astype(np.int64), (1 << MAX_DEPTH) - 1
        voxels = np.stack([codes >> 2 * MAX_DEPTH, codes >> MAX_DEPTH & mask, codes & mask], 1).astype(np.int32)
        return voxels if self._quantiser.qp == 0 else np.unique(self._quantiser.steps(voxels), axis=0)

    @cached_property
    def voxels_per_cube(self) -> float:
        """Occupied voxels per occupied cube of 4 x 4 x 4, about; 0 for a sample without points."""
        cubes = self.voxels.astype(np.int64) >> 2
        keys = cubes[:, 0] << 42 | cubes[:, 1] << 21 | cubes[:, 2]
        return len(keys) / max(1, len(np.unique(keys)))

    def planes_pay(self, without: GeometryParameters, with_planes: GeometryParameters) -> bool:
        """Whether coding the sample takes less with planes."""
        voxels = self.voxels
        if len(voxels) < 100:
            return False
        voxels = voxels - voxels.min(0)
        bits = [int(value).bit_length() for value in voxels.max(0)]
        coder = SliceCoder()
        coder.build(voxels, max(1, *bits))
        plain = (replace(tools, scaling=False) for tools in (without, with_planes))
        sizes = [len(coder.encode_geometry(tools, split_axes(bits))) for tools in plain]
        return sizes[1] < (1 - GeometryTuning.planes_gain) * sizes[0]


def split_axes(bits: Sequence[int]) -> tuple[int, ...]:
    """By level of a tree over sides of 2^bits, the axes that it splits: always the longest, at last all of them."""
    left, levels = list(bits), []
    if not any(left):
        left[0] = 1
    while any(left):
        longest = max(left)
        levels.append(sum(4 >> axis for axis in range(3) if left[axis] == longest))
        left = [side - (side == longest) for side in left]
    return tuple(levels)


def geometry_parameters(settings: CodecSettings, sample: GeometrySample) -> GeometryParameters:
    """The parameter set of a stream."""
    boundary = settings.neighbour_boundary
    if boundary is None:
        boundary = 8 if sample.voxels_per_cube > GeometryTuning.dense else 0
    without = _parameters(settings, boundary, False)
    if settings.planes is False or (settings.planes is None and sample.voxels_per_cube > GeometryTuning.planes):
        return without
    near = 8 if settings.neighbour_boundary is None else boundary
    with_planes = _parameters(settings, near, True)
    return with_planes if settings.planes or sample.planes_pay(without, with_planes) else without


def _parameters(settings: CodecSettings, boundary: int, planes: bool) -> GeometryParameters:
    near, qp = boundary > 0, settings.geometry_qp
    return GeometryParameters(
        settings.duplicates == "merge", boundary, near and settings.adjacent_child,
        settings.intra_prediction_size if near else 0, partial_splits=planes, planes=planes,
        plane_thresholds=PLANE_THRESHOLDS if planes else (0, 0, 0), scaling=qp > 0, base_qp=qp,
    )  # fmt: skip


def tree_sides(parameters: GeometryParameters, bits: Sequence[int]) -> list[int]:
    """Logarithms of the sides of the tree over a slice with sides of 2^bits."""
    return list(bits) if parameters.partial_splits else [max(1, *bits)] * 3


def levels_of(parameters: GeometryParameters, sides: Sequence[int]) -> tuple[int, ...]:
    """The axes that the levels of a tree with these `tree_sides` split."""
    return split_axes(sides) if parameters.partial_splits else (ALL_AXES,) * max(sides)
