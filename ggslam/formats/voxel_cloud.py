# SPDX-License-Identifier: Apache-2.0
"""Coloured points on a regular grid, and the sums that they are made of."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from ggslam.system.tuning import Tuning

BITS: Final = 21
"""Bits per axis of a packed voxel number: three axes fit 63 bits."""


class VoxelCloudTuning(Tuning):
    """Where points lie in their voxels."""

    max_offset = 0.499
    """Largest distance of a point from its voxel's centre along an axis, in voxels: rounding finds the voxel again."""


@dataclass(frozen=True)
class VoxelCloud:
    """Coloured points on a regular grid, at most one per voxel, sorted by grid coordinate (z fastest).

    Attributes:
        grid: int32 [N, 3] grid coordinates, none negative.
        colors: uint8 [N, 3] RGB.
        object_id: int32 [N], 0 = unlabelled, or None.
        voxel_size: metres.
        origin: float64 [3], metres: where grid coordinate (0, 0, 0) lies; a whole multiple of the voxel size.
        offsets: float32 [N, 3], where in its voxel each point lies: what its position has beyond the voxel's centre,
            in voxels, -0.5 to 0.5. None: at the centre.
    """

    grid: np.ndarray
    colors: np.ndarray
    object_id: np.ndarray | None
    voxel_size: float
    origin: np.ndarray
    offsets: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.grid)

    @property
    def points(self) -> np.ndarray:
        """Positions in metres, float64 [N, 3]: origin + voxel_size * (grid + offsets)."""
        return self.origin + self.voxel_size * (self.grid if self.offsets is None else self.grid + self.offsets)


def join_clouds(clouds: Iterable[VoxelCloud]) -> VoxelCloud:
    """Clouds on one grid as one, in the order of its voxels; an empty one of none."""
    parts = [cloud for cloud in clouds if len(cloud)]
    if not parts:
        return cloud_of_sums(VoxelSums.empty(), 1.0, False)
    size = parts[0].voxel_size
    lattice = np.concatenate([part.grid + np.rint(part.origin / size).astype(np.int64) for part in parts])
    order, corner = np.argsort(pack(lattice), kind="stable"), lattice.min(0)

    def column(name: str) -> np.ndarray | None:
        values = [getattr(part, name) for part in parts]
        return None if any(value is None for value in values) else np.concatenate(values)[order]

    colors = column("colors")
    assert colors is not None
    grid = (lattice[order] - corner).astype(np.int32)
    return VoxelCloud(grid, colors, column("object_id"), size, corner * size, column("offsets"))


def pack(lattice: np.ndarray) -> np.ndarray:
    """One int64 per voxel from signed coordinates [N, 3]."""
    x, y, z = (lattice + (1 << (BITS - 1))).T
    return (x << 2 * BITS) | (y << BITS) | z


def unpack(key: np.ndarray) -> np.ndarray:
    limit = (1 << BITS) - 1
    return np.stack([key >> 2 * BITS, (key >> BITS) & limit, key & limit], 1) - (1 << (BITS - 1))


@dataclass(frozen=True)
class VoxelSums:
    """Weighted sums per voxel and object: key and label [N] (sorted, unique pairs once joined), weight, colour, and
    position in metres, if it counts; else points are the centres of their voxels."""

    key: np.ndarray
    label: np.ndarray
    weight: np.ndarray
    color: np.ndarray
    position: np.ndarray | None = None

    @staticmethod
    def empty() -> VoxelSums:
        return VoxelSums(np.empty(0, np.int64), np.empty(0, np.int32), np.empty(0), np.empty((0, 3)))

    def of_rows(self, chosen: np.ndarray) -> VoxelSums:
        """Some rows, bool [N]."""
        position = None if self.position is None else self.position[chosen]
        return VoxelSums(self.key[chosen], self.label[chosen], self.weight[chosen], self.color[chosen], position)

    @staticmethod
    def of(parts: list[VoxelSums]) -> VoxelSums:
        """All parts together, one row per (voxel, label)."""
        key, label = np.concatenate([p.key for p in parts]), np.concatenate([p.label for p in parts])
        order = np.lexsort((label, key)) if label.any() else np.argsort(key, kind="stable")
        key, label = key[order], label[order]
        starts = np.nonzero(_first_of_runs(key) | _first_of_runs(label))[0]
        if not len(starts):
            return parts[0]
        weight = np.concatenate([p.weight for p in parts])[order]
        color = np.concatenate([p.color for p in parts])[order]
        position = None
        if all(p.position is not None for p in parts):
            position = np.add.reduceat(np.concatenate([p.position for p in parts])[order], starts)
        weight, color = np.add.reduceat(weight, starts), np.add.reduceat(color, starts)
        return VoxelSums(key[starts], label[starts], weight, color, position)


def _first_of_runs(values: np.ndarray) -> np.ndarray:
    first = np.ones(len(values), bool)
    first[1:] = values[1:] != values[:-1]
    return first


def cloud_of_sums(
    sums: VoxelSums, voxel_size: float, with_object_id: bool, least_weight: float = 0.0
) -> VoxelCloud:
    """One point for each voxel: with the mean colour and position, and the object of most weight.

    Args:
        sums: colours in [0, 1].
        voxel_size: metres.
        with_object_id: whether the points carry object ids.
        least_weight: voxels of less give no point.
    """
    if not len(sums.key):
        nothing = np.empty((0, 3), np.int32)
        ids = np.empty(0, np.int32) if with_object_id else None
        return VoxelCloud(nothing, nothing.astype(np.uint8), ids, voxel_size, np.zeros(3))
    # Heaviest label first within each voxel, the smaller id at a tie: the first row of each run then names the object.
    order = np.lexsort((sums.label, -sums.weight, sums.key))
    key, label = sums.key[order], sums.label[order]
    starts = np.nonzero(_first_of_runs(key))[0]
    weight = np.add.reduceat(sums.weight[order], starts)
    kept = weight >= least_weight
    if not kept.any():
        return cloud_of_sums(sums.of_rows(np.zeros(len(sums.key), bool)), voxel_size, with_object_id)
    color = (np.add.reduceat(sums.color[order], starts) / weight[:, None])[kept]
    lattice, offsets = unpack(key[starts[kept]]), None
    if sums.position is not None:
        position = (np.add.reduceat(sums.position[order], starts) / weight[:, None])[kept]
        most = VoxelCloudTuning.max_offset
        offsets = (position / voxel_size - lattice).clip(-most, most).astype(np.float32)
    corner = lattice.min(0)
    return VoxelCloud(
        grid=(lattice - corner).astype(np.int32),
        colors=np.rint(255 * color).astype(np.uint8),
        object_id=label[starts[kept]] if with_object_id else None,
        voxel_size=voxel_size,
        origin=corner * voxel_size,
        offsets=offsets,
    )
