# SPDX-License-Identifier: Apache-2.0
"""Settings of all volumes together."""

from __future__ import annotations

from dataclasses import field

from ggslam.system.settings import setting, settings_class
from ggslam.volumes.esdf import FieldSettings
from ggslam.volumes.occupancy_settings import OccupancySettings
from ggslam.volumes.settings import TsdfSettings


@settings_class(frozen=True)
class VolumeSettings:
    """What `ggslam volumes` makes."""

    tsdf: TsdfSettings = field(default_factory=TsdfSettings)
    esdf: FieldSettings = field(default_factory=FieldSettings)
    occupancy: OccupancySettings = field(default_factory=OccupancySettings.with_raised_odds)
    min_weight: float = setting(0.0, 0, 1000)
    """Least weight of voxels that the mesh is made of, in measurements from 1 m; 0: automatic, half a measurement from
    the farthest depth that is fused."""
    esdf_every: int = setting(0, 0, 10**6, "frames")
    """The distance field is updated with every n-th frame; 0: with every one when volumes are made live or their
    latency is to be reported, else once at the end."""
    decay_every: int = setting(0, 0, 10**6, "frames")
    """Weights of the TSDF decay with every n-th frame; 0: never. For live maps of places where things move out of
    sight; a map made of a recording would lose what the camera saw first."""
