# SPDX-License-Identifier: Apache-2.0
"""Numbers of the truncated signed distance field."""

from __future__ import annotations

from dataclasses import dataclass

from ggslam.errors import check_ranges


@dataclass(frozen=True)
class TsdfSettings:
    """How depth is fused."""

    voxel: float = 0.02
    """Edge of a voxel, metres."""
    truncation_voxels: float = 4.0
    """Distances are kept up to this many voxels on either side of a surface."""
    max_weight: float = 16.0
    """A voxel's weight grows to this at most, in measurements from 1 m: how many of them new ones are averaged with."""
    max_free_weight: float = 1.0
    """The same for voxels of free space, so that what appears in it is taken over soon."""
    min_depth: float = 0.1
    max_depth: float = 7.0
    """Range of depth used, metres."""
    free_share: float = 0.9
    """A block without voxels becomes free throughout if all depth seen through it lies behind it, and at least this
    share of its pixels have depth. Else it gets voxels, if it is not known yet, until all of them were seen."""
    edge_voxels: float = 2.0
    """Where the four pixels around a projected voxel differ by more than this many voxels and 2 % of the depth, the
    nearest of them is taken instead of interpolating across the edge."""
    clearing: float = 0.5
    """A voxel that depth now passes by more than the truncation, and by more than half of it farther than the voxel's
    distance tells, loses this share of its weight first, so that what was taken away goes in a few frames. 0: it is
    outvoted frame by frame."""
    decay: float = 0.95
    """Weights are multiplied by this at every call of `TsdfMap.decay`."""

    def __post_init__(self) -> None:
        ranges = {
            "voxel": (1e-3, 1), "truncation_voxels": (2, 32), "max_weight": (1, 1000), "max_free_weight": (0.1, 1000),
            "min_depth": (0, 100),
            "max_depth": (0.1, 1000), "free_share": (0.1, 1), "edge_voxels": (0.1, 100), "clearing": (0, 0.99),
            "decay": (0.01, 1),
        }  # fmt: skip
        check_ranges(self, ranges)

    @property
    def truncation(self) -> float:
        """In metres."""
        return self.truncation_voxels * self.voxel
