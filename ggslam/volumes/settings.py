# SPDX-License-Identifier: Apache-2.0
"""Numbers of the truncated signed distance field."""

from __future__ import annotations

from ggslam.system.settings import Conflict, setting, settings_class


@settings_class(frozen=True)
class TsdfSettings:
    """How depth is fused."""

    voxel: float = setting(0.02, 1e-3, 1, "m", basic=True)
    """Edge of a voxel."""
    truncation_voxels: float = setting(4.0, 2, 32, "voxels")
    """Distances are kept up to this many voxels on either side of a surface."""
    max_weight: float = setting(16.0, 1, 1000)
    """A voxel's weight grows to this at most, in measurements from 1 m: how many of them new ones are averaged with."""
    max_free_weight: float = setting(1.0, 0.1, 1000)
    """The same for voxels of free space, so that what appears in it is taken over soon."""
    min_depth: float = setting(0.1, 0, 100, "m")
    """Nearer depth is not fused."""
    max_depth: float = setting(7.0, 0.1, 1000, "m", basic=True)
    """Farther depth is not fused."""
    free_share: float = setting(0.9, 0.1, 1)
    """A block without voxels becomes free throughout if all depth seen through it lies behind it, and at least this
    share of its pixels have depth. Else it gets voxels, if it is not known yet, until all of them were seen."""
    edge_voxels: float = setting(2.0, 0.1, 100, "voxels")
    """Where the four pixels around a projected voxel differ by more than this many voxels and 2 % of the depth, the
    nearest of them is taken instead of interpolating across the edge."""
    clearing: float = setting(0.5, 0, 0.99)
    """A voxel that depth now passes by more than the truncation, and by more than half of it farther than the voxel's
    distance tells, loses this share of its weight first, so that what was taken away goes in a few frames. 0: it is
    outvoted frame by frame."""
    decay: float = setting(0.95, 0.01, 1)
    """Weights are multiplied by this at every call of `TsdfMap.decay`."""

    def __post_init__(self) -> None:
        if self.min_depth >= self.max_depth:
            raise Conflict("max_depth", f"expected more than min_depth, {self.min_depth:g}, found {self.max_depth:g}")

    @property
    def truncation(self) -> float:
        """In metres."""
        return self.truncation_voxels * self.voxel
