# SPDX-License-Identifier: Apache-2.0
"""Floors in voxels larger than what a robot drives over: measured floor is no obstacle, low things on it are."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "volumes"))
from analytic_scenes import Box, Plane, Union, looking_at, render_depth, small_camera  # noqa: E402

from ggslam.driving.bands import BandMap, band_map  # noqa: E402
from ggslam.driving.robot import Robot  # noqa: E402
from ggslam.volumes.esdf import DistanceField  # noqa: E402
from ggslam.volumes.settings import TsdfSettings  # noqa: E402
from ggslam.volumes.tsdf import TsdfMap  # noqa: E402

LOW, HIGH = np.array([0.32, -0.21]), np.array([0.77, 0.26])
"""Corners of a box on the floor, metres."""
CELL = 0.1


def measured(voxel: float, floor: float, height: float = 0.16) -> BandMap:
    """What a low robot meets on a floor as seen from around; the map's z is up, the floor at this height of it."""
    (x0, y0), (x1, y1) = LOW.tolist(), HIGH.tolist()
    box = Box((x0, y0, floor), (x1, y1, floor + height))
    scene, camera = Union((Plane((0.0, 0.0, 1.0), floor), box)), small_camera()
    tsdf = TsdfMap(TsdfSettings(voxel=voxel))
    for turn in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        eye = np.array([1.8 * np.cos(turn), 1.8 * np.sin(turn), floor + 1.1])
        pose = looking_at(eye, np.array([0.1, 0.0, floor]))
        tsdf.integrate(render_depth(scene, camera, pose), camera, pose)
    field = DistanceField(tsdf)
    field.update()
    T_floor_map = np.eye(4)
    T_floor_map[2, 3] = -floor
    return band_map(field, T_floor_map, Robot(0.4, 0.2), CELL)


@pytest.mark.parametrize("voxel", [0.05, 0.1])
@pytest.mark.parametrize("floor", [0.0, -0.002, 0.013, -0.009])
def test_the_floor_is_free_and_the_box_is_not(voxel: float, floor: float) -> None:
    band = measured(voxel, floor)
    places = band.grid.centres()
    q = np.abs(places - (LOW + HIGH) / 2) - (HIGH - LOW) / 2
    gap = np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)
    seen = np.linalg.norm(places, axis=-1) < 1.0
    assert band.free[seen & (gap > 2 * voxel)].mean() > 0.98 and (seen & (gap > 2 * voxel)).sum() > 100
    assert not band.free[gap < 0].any() and band.occupied[gap < 0].mean() > 0.5
    away = seen & (gap > 2 * voxel) & (gap < 0.6)
    assert np.abs(band.distance - gap)[away].max() < voxel and np.abs(band.distance - gap)[away].mean() < 0.4 * voxel


@pytest.mark.parametrize("floor", [0.0, -0.002, 0.013, 0.031])
def test_a_box_hardly_higher_than_the_step_is_not_free(floor: float) -> None:
    band = measured(0.1, floor, 0.07)
    inside = ((band.grid.centres() > LOW + CELL / 2) & (band.grid.centres() < HIGH - CELL / 2)).all(-1)
    assert inside.sum() > 5 and not band.free[inside].any()
