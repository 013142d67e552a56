# SPDX-License-Identifier: Apache-2.0
"""Settings of all volumes together."""

from __future__ import annotations

from dataclasses import field

from ggslam.system.settings import setting, settings_class, tuning_class
from ggslam.volumes.esdf import FieldSettings
from ggslam.volumes.occupancy_settings import OccupancySettings
from ggslam.volumes.settings import TsdfSettings


@tuning_class(frozen=True)
class VolumeTuning:
    """Numbers of volumes."""

    min_weight: float = setting(0.0, 0, 1000)
    """Least weight of a voxel that is meshed, in measurements from 1 m; 0: automatic: half a measurement from the
    largest depth fused."""
    budget_ms: float = setting(0.0, 0, 1e6, "ms")
    """Time a frame for TSDF and distance field; what is far from the camera waits for a later frame. 0: as long as it
    takes."""

    def left_for_field_ms(self, fusion_ms: float) -> float | None:
        """Milliseconds of a frame's budget that fusing, which took `fusion_ms`, leaves to the distance field: at least
        a little, so that it never waits for good; None: as long as it takes."""
        return max(self.budget_ms - fusion_ms, 1e-3) if self.budget_ms else None


@settings_class(frozen=True)
class VolumeSettings(VolumeTuning):
    """What `ggslam volumes` makes."""

    tsdf: TsdfSettings = field(default_factory=TsdfSettings)
    esdf: FieldSettings = field(default_factory=FieldSettings)
    occupancy: OccupancySettings = field(default_factory=OccupancySettings.with_raised_odds)
    esdf_every: int = setting(0, 0, 10**6, "frames")
    """Update the distance field every n-th frame; 0: every frame in live use, else once at the end."""
    budget_mb: float = setting(0.0, 0, 1e9, "MB")
    """Memory for TSDF and distance field: what does not fit is kept on disk while frames are fused. 0: automatic: what
    `memory_limit_mb` leaves, or with `live` a quarter of that; without it no limit."""
    decay_every: int = setting(0, 0, 10**6, "frames")
    """Decay the weights of the TSDF every n-th frame, for live maps of changing places; 0: never."""
