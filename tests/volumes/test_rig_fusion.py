# SPDX-License-Identifier: Apache-2.0
"""What the cameras of a rig see at one instant is one surface, where it is in truth."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_scenes import Box, Sphere, Union, looking_at, render_depth, small_camera

from ggslam.volumes.maps import VolumeMaps
from ggslam.volumes.posed_view import PosedView
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.volume_settings import VolumeSettings

ROOM = Union((Box((-2.0, -1.3, -2.2), (2.3, 1.4, 1.9), inside_out=True), Sphere((0.9, 0.4, 0.8), 0.4)))
VOXEL = 0.04
SETTINGS = VolumeSettings(tsdf=TsdfSettings(voxel=VOXEL), esdf_every=1)
SIDES = np.array([(0, 0, 1), (1, 0, 0), (0, 0, -1), (-1, 0, 0)], float)


def views(cameras: int, at: np.ndarray) -> list[PosedView]:
    """Of cameras that look to as many sides, 6 cm from the middle of their rig."""
    found = []
    for side in SIDES[:cameras]:
        camera, T = small_camera(200, 160), looking_at(at + 0.06 * side, at + side)
        found.append(PosedView(render_depth(ROOM, camera, T), camera, T))
    return found


@pytest.mark.parametrize("cameras", [2, 3, 4])
def test_the_surface_of_all_cameras_is_the_scenes(cameras: int) -> None:
    maps = VolumeMaps(SETTINGS, esdf=True, occupancy=0.1)
    for x in np.linspace(-0.5, 0.4, 4):
        maps.add_together(views(cameras, np.array([x, 0.05, -0.2])))
    assert len(maps.times.rows) == 4 and maps.points == 4 * cameras * 200 * 160
    mesh, points = maps.mesh(50), views(cameras, np.array([-0.5, 0.05, -0.2]))[-1].points()
    off = np.abs(ROOM.distance(mesh.vertices.astype(float)))
    assert np.median(off) < 0.001 and np.percentile(off, 95) < 0.005  # of voxels of 4 cm
    assert maps.field is not None and maps.occupancy is not None
    seen = maps.field.query(points)  # what the last camera alone sees is there, too
    assert seen.known.mean() > 0.99 and np.nanmedian(np.abs(seen.distance)) < 0.002
    centers, _ = maps.occupancy.occupied_centers()
    assert np.abs(ROOM.distance(centers.astype(float))).max() < 0.1 * np.sqrt(3) / 2 + 1e-6


def test_images_of_1280x720_are_fused_whole() -> None:
    maps, at = VolumeMaps(SETTINGS, occupancy=0.1), np.array([-0.5, 0.05, -0.2])
    camera, T = small_camera(1280, 720), looking_at(at, at + SIDES[0])
    maps.add_together([PosedView(render_depth(ROOM, camera, T), camera, T)])
    off = np.abs(ROOM.distance(maps.mesh(50).vertices.astype(float)))
    assert maps.points == 1280 * 720
    assert np.median(off) < 0.001 and np.percentile(off, 95) < 0.005
