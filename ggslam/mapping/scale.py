# SPDX-License-Identifier: Apache-2.0
"""The mapper's settings for a scene larger than a room; see `geometry.scene_size`."""

from __future__ import annotations

from dataclasses import replace

from ggslam.geometry.scene_size import voxel_times
from ggslam.mapping.settings import MapperSettings


def scale_settings(settings: MapperSettings, scale: float) -> MapperSettings:
    """The settings with lengths times `voxel_times(scale)`, and the weight of depth over it, so that a scene is mapped
    as a room of its shape; in rooms the same. Lengths that follow the depth noise are left alone.

    Args:
        settings: as configured.
        scale: of the scene, see `geometry.scene_size.scene_scale`.
    """
    times = voxel_times(scale)
    if times == 1:
        return settings
    return replace(
        settings,
        insertion=replace(settings.insertion, max_depth_m=min(settings.insertion.max_depth_m * times, 1e4)),
        rates=replace(settings.rates, means=min(settings.rates.means * times, 10.0)),
        pruning=replace(settings.pruning, max_scale_m=min(settings.pruning.max_scale_m * times, 1e4)),
        loss=replace(settings.loss, depth_weight=settings.loss.depth_weight / times),
    )
