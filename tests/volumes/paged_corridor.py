# SPDX-License-Identifier: Apache-2.0
"""A corridor with balls, seen on the way there and back, and maps of it that may go to disk."""

from __future__ import annotations

import numpy as np
from analytic_scenes import Box, Scene, Sphere, Union, looking_at, render_depth, small_camera

from ggslam.volumes.maps import Paging, VolumeMaps
from ggslam.volumes.posed_view import PosedView
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.volume_settings import VolumeSettings

LENGTH = 14.0
SETTINGS = VolumeSettings(tsdf=TsdfSettings(voxel=0.08, max_depth=4.0))
CAMERA = small_camera(120, 90)


def corridor() -> Scene:
    balls = [Sphere((x, 0.7 * (-1) ** k, 0.4), 0.3) for k, x in enumerate(np.arange(1.5, LENGTH, 2.5))]
    return Union((Box((-1.0, -1.2, -1.3), (LENGTH + 1, 1.2, 1.2), inside_out=True), *balls))


def views(there_and_back: bool = True) -> list[PosedView]:
    """Along the corridor, and back, looking ahead and to the sides by turns."""
    way = np.arange(0.0, LENGTH, 0.5)
    way = np.concatenate([way, way[::-1]]) if there_and_back else way
    ahead = np.ones(len(way)) if not there_and_back else np.repeat([1.0, -1.0], len(way) // 2)
    scene, found = corridor(), []
    for k, (x, forward) in enumerate(zip(way, ahead, strict=True)):
        at = np.array([x, 0.1 * np.sin(k), 0.0])
        T = looking_at(at, at + (forward, 0.7 * np.sin(k), 0.1 * np.cos(k)))
        found.append(PosedView(render_depth(scene, CAMERA, T), CAMERA, T))
    return found


def fuse(seen: list[PosedView], paging: Paging | None = None, settings: VolumeSettings = SETTINGS, esdf: bool = False
         ) -> VolumeMaps:  # fmt: skip
    maps = VolumeMaps(settings, esdf=esdf)
    maps.paging = paging
    for view in seen:
        maps.add_together([view])
    return maps
