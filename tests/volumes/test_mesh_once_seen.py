# SPDX-License-Identifier: Apache-2.0
"""What one view shows has a mesh, whatever its distance in range: completeness and accuracy on exact walls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from analytic_scenes import Plane, render_depth, small_camera
from scipy.spatial import cKDTree

from ggslam.volumes.mesh import extract_mesh
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap

CAMERA = small_camera(320, 240)


@pytest.mark.parametrize("voxel", [0.02, 0.05])
@pytest.mark.parametrize("distance", [0.5, 1.7, 3.3, 5.0, 6.5])
@pytest.mark.parametrize("tilt", [0.0, 0.5])
def test_a_wall_seen_once_has_a_mesh(voxel: float, distance: float, tilt: float) -> None:
    normal = np.array([np.sin(tilt), 0, -np.cos(tilt)])
    depth = render_depth(Plane(tuple(normal), float(normal[2] * distance)), CAMERA, np.eye(4))
    tsdf = TsdfMap(TsdfSettings(voxel=voxel))
    tsdf.integrate(depth, CAMERA, np.eye(4))
    mesh = extract_mesh(tsdf)
    points = CAMERA.back_project(depth).astype(np.float64)
    rim = int(np.ceil(2.5 * voxel * CAMERA.fx / depth.min())) + 1  # a cell needs voxels on all sides
    far = np.zeros(depth.shape, bool)
    far[rim:-rim, rim:-rim] = True
    seen = points[far & (depth > 0.2) & (depth < 7 - 4 * voxel)]
    assert len(seen) > 500
    away, _ = cKDTree(mesh.vertices).query(seen)
    assert (away < voxel).mean() >= 0.999
    off = np.abs(mesh.vertices @ normal - normal[2] * distance)  # at the image's border depth is not interpolated
    assert np.percentile(off, 95) < 0.02 * voxel and off.max() < 0.5 * voxel


def test_the_least_weight_follows_the_range() -> None:
    usual = TsdfSettings()
    assert usual.least_weight == pytest.approx(0.5 / 49)
    assert usual.of_size(4).least_weight == pytest.approx(usual.least_weight / 16)
    tsdf = TsdfMap(replace(usual, voxel=0.05))
    tsdf.integrate(np.full((240, 320), 3.3, np.float32), CAMERA, np.eye(4))
    assert len(extract_mesh(tsdf).triangles) > 1000
    assert len(extract_mesh(tsdf, 0.1).triangles) == 0  # one look from 3.3 m weighs 0.092
