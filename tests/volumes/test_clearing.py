# SPDX-License-Identifier: Apache-2.0
"""What later views look past goes; what they may miss by an error of pose or depth is not lost to one of them."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_scenes import Plane, Scene, render_depth, small_camera

from ggslam.volumes.mesh import extract_mesh
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap

CAMERA = small_camera(160, 120)
SETTINGS = TsdfSettings(voxel=0.02)
Z = 3.0


def wall(z: float) -> Scene:
    return Plane((0, 0, -1), -z)


def left_of_wall(tsdf: TsdfMap) -> float:
    """Share of the wall at Z, 1 m wide and high, that has mesh within one and a half voxels."""
    mesh = extract_mesh(tsdf)
    centres = mesh.vertices[mesh.triangles].mean(1)
    near = centres[(np.abs(centres[:, 2] - Z) < 1.5 * SETTINGS.voxel) & (np.abs(centres[:, :2]) < 0.5).all(1)]
    cells = np.unique(np.floor((near[:, :2] + 0.5) / 0.05).astype(int), axis=0)
    return len(cells) / 20**2


def views_until(tsdf: TsdfMap, scene: Scene, share: float, most: int) -> int:
    """Number of views of a scene until less than a share of the wall is left."""
    for n in range(1, most + 1):
        tsdf.integrate(render_depth(scene, CAMERA, np.eye(4)), CAMERA, np.eye(4))
        if left_of_wall(tsdf) < share:
            return n
    return most + 1


@pytest.mark.parametrize(("gap", "least", "most"), [(0.12, 5, 12), (0.2, 5, 12), (0.3, 1, 2), (1.0, 1, 2)])
def test_a_wall_goes_at_once_if_views_surely_pass_it(gap: float, least: int, most: int) -> None:
    """By more than the truncation, 8 cm, and 3 % of the depth, 9 cm; else after more views."""
    tsdf = TsdfMap(SETTINGS)
    tsdf.integrate(render_depth(wall(Z), CAMERA, np.eye(4)), CAMERA, np.eye(4))
    assert left_of_wall(tsdf) == 1
    assert least <= views_until(tsdf, wall(Z + gap), 0.01, most) <= most
