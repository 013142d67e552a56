# SPDX-License-Identifier: Apache-2.0
"""Positions to grid and back: p~ = clip(round(s p) - o, c_min, c_max), as in the slice-parallel G-PCC encoder for
embedded systems whose equations 4 and 5 these are (which cut off, where this rounds). The scale s is a number of voxels
per metre, o an integer origin.

A grid coordinate g denotes the centre of its voxel, the point (g + o) / s: so have it the grids of `VoxelCloud`, clouds
of whole numbers, and the standard, by which every decoder places the points. The sequence parameter set holds s as a
quotient of integers and o as the offset of its box; a scale that is no such quotient travels exactly in a user data
unit.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Final

import numpy as np

from ggslam.coding.geometry_syntax import MAX_DEPTH
from ggslam.coding.grid_points import GridPoints
from ggslam.errors import ConfigError
from ggslam.system.tuning import Tuning


class QuantizationTuning(Tuning):
    """How positions are rounded to the grid."""

    rounding = 1e-3
    """Voxels that a coordinate may lie below a voxel's face: points on faces stay apart however they were rounded."""
    min_voxel_m = 1e-6
    """Voxel of a cloud without extent, in metres."""


_MAX_FIELD: Final = (1 << 32) - 2
"""Largest numerator and denominator of a scale: fields have 32 bits."""


@dataclass(frozen=True)
class Quantization:
    """How positions lie on the grid.

    scale: voxels per unit of the positions (metres, or steps of an integer grid).
    origin: subtracted from round(scale p), voxels.
    size: voxels along each axis; grid positions are clipped to [0, size - 1].
    centre: added to grid positions when they are restored, in voxels: 0, but in streams of earlier versions, whose
        coordinates denote the lowest corner of a voxel.
    metres: whether restored positions are metres.
    unit: length of a step of the positions, in metres if `metres`.
    shift: added to restored positions.
    global_scale: grid positions are multiplied by it before the origin is added; 1 except in streams of other encoders.
    """

    scale: float
    origin: tuple[int, int, int] = (0, 0, 0)
    size: tuple[int, int, int] | None = None
    centre: float = 0.0
    metres: bool = False
    unit: float = 1.0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    global_scale: float = 1.0

    @property
    def voxel_size(self) -> float:
        """Edge of a voxel, in the unit of restored positions."""
        return self.unit / self.scale * self.global_scale

    @property
    def first(self) -> np.ndarray:
        """Where grid position 0 is restored to, float64 [3]."""
        return self.restore(np.zeros((1, 3), np.int32))[0]

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Grid positions int32 [N, 3] of points [N, 3]."""
        return self.of(points).positions()

    def of(self, points: np.ndarray) -> GridPoints:
        """Points [N, 3] seen on this grid."""
        size = self.size or (1 << 31,) * 3
        exact = self.scale == 1 and np.issubdtype(points.dtype, np.integer)
        return GridPoints(points, self.scale, 0.5 + QuantizationTuning.rounding, self.origin, size, exact)

    def restore(self, grid: np.ndarray) -> np.ndarray:
        """Positions float64 [N, 3] of grid positions."""
        points = grid.astype(np.float64)
        if self.global_scale != 1:
            points *= self.global_scale
        points += np.asarray(self.origin, np.float64) + self.centre
        points /= self.scale
        if self.unit != 1:
            points *= self.unit
        if any(self.shift):
            points += self.shift
        return points

    def resolution(self) -> tuple[Fraction, bool]:
        """Voxels per unit of length as the sequence parameter set holds them, and whether that is exact."""
        scale = self.scale / self.unit
        exact = Fraction(scale)
        if max(exact.numerator, exact.denominator) <= _MAX_FIELD:
            return exact, True
        if not 1 / _MAX_FIELD <= scale <= _MAX_FIELD / 2:
            raise ConfigError(f"{scale:g} voxels per unit of length is outside the range of the format")
        near = exact.limit_denominator(min(_MAX_FIELD, int(_MAX_FIELD / 2 / scale)))
        return near, float(near) == scale


def _extent(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates [3] of points [N, 3]. Rows of many points at once keep the reduction's inner loop
    long: several times as fast as over axis 0 of [N, 3]."""
    together = 1024
    whole = len(points) // together * together
    blocks = np.ascontiguousarray(points)[:whole].reshape(-1, 3 * together)
    rest = points[whole:]
    if not whole:
        return rest.min(0), rest.max(0)
    low, high = blocks.min(0).reshape(-1, 3), blocks.max(0).reshape(-1, 3)
    return np.concatenate([low, rest]).min(0), np.concatenate([high, rest]).max(0)


def choose_quantization(
    points: np.ndarray,
    voxel_size: float | None,
    bits: int,
    geometry_scale: float,
    box: tuple[tuple[float, float, float], tuple[float, float, float]] | None,
    unit: float | None = None,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Quantization:
    """The grid for points [N, 3], float (metres) or integer (voxels already).

    Args:
        voxel_size: edge of a voxel before scaling; None: 1 for integers, else the cloud's longest side over 2^bits - 1.
        geometry_scale: finer (above 1) or coarser.
        box: lowest and highest corner to clip to; None: that of the points.
        unit: length of a step of integer positions, metres; None: they are no lengths.
        shift: where integer position 0 stands, metres.

    Raises:
        ConfigError: a grid of more than 21 bits, or a unit for positions that are no integers.
    """
    if unit is not None and not np.issubdtype(points.dtype, np.integer):
        raise ConfigError("CodecSettings.unit goes with integer positions")
    low, high = (np.asarray(corner, np.float64) for corner in box or _extent(points))
    integers = np.issubdtype(points.dtype, np.integer)
    if voxel_size is None:
        longest = float((high / 2 - low / 2).max()) * 2
        least = max(
            QuantizationTuning.min_voxel_m, float(np.abs([low, high]).max()) * 2.0**-50
        )  # of points all at one place
        voxel_size = 1.0 if integers else longest / ((1 << bits) - 1) if longest else least
        if not 1e-12 <= voxel_size <= 1e12:
            raise ConfigError(f"positions that span {longest:g} fit on no grid: name a voxel size")
    scale = geometry_scale / voxel_size
    with np.errstate(over="ignore", invalid="ignore"):
        first, last = (np.floor(corner * scale + 0.5 + QuantizationTuning.rounding) for corner in (low, high))
    if not np.isfinite(first).all() or not np.isfinite(last).all() or np.abs([first, last]).max() >= 1 << 52:
        raise ConfigError(f"voxels of {1 / scale:g} are too small for positions up to {np.abs([low, high]).max():g}")
    extent = (last - first).astype(np.int64) + 1
    if extent.max() > 1 << MAX_DEPTH:
        raise ConfigError(
            f"the grid is {extent.max()} voxels long, more than 2^{MAX_DEPTH}: choose larger voxels "
            f"(now {1 / scale:g}) or a smaller geometry scale"
        )
    x, y, z = (int(v) for v in first)
    return Quantization(scale, (x, y, z), (int(extent[0]), int(extent[1]), int(extent[2])),
                        metres=unit is not None or not integers, unit=unit or 1.0, shift=shift)  # fmt: skip
