# SPDX-License-Identifier: Apache-2.0
"""The fusion in torch against the compiled one. Both round values to the same steps, but add and multiply in another
order: a voxel differs by a few steps, or wholly where a comparison (nearest pixel, edge, clearing) is a tie."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_scenes import Box, Sphere, Union, looking_at, render_depth, small_camera

from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap
from ggslam.volumes.tsdf_torch import TorchTsdf


def views(n: int) -> list[tuple]:
    """A ball in a room, which goes after half of the views; with holes in the depth."""
    camera, rng = small_camera(90, 70), np.random.default_rng(0)
    room = Box((-1.5, -1, -1), (1.5, 1, 3.0), True)
    found = []
    for k in range(n):
        T = looking_at(np.array([-0.6 + 1.2 * k / n, -0.3, 0.0]), np.array([0, 0, 2.0]))
        depth = render_depth(Union((Sphere((0, 0, 2), 0.5), room)) if 2 * k < n else room, camera, T)
        depth[rng.random(depth.shape) < 0.02] = np.nan
        color = rng.integers(0, 255, (*depth.shape, 3), np.uint8)
        found.append((depth, camera, T, color, np.where(depth < 2, 7, 3).astype(np.uint16)))
    return found


@pytest.mark.long("the reference in plain torch")
@pytest.mark.parametrize("voxel", [0.03, 0.08])
def test_torch_and_native_fusion_agree(voxel: float) -> None:
    settings = TsdfSettings(voxel=voxel)
    tsdf, other = TsdfMap(settings), TorchTsdf(settings)
    for view in views(10):
        tsdf.integrate(*view)
        other.integrate(*view)
    assert len(other) == pytest.approx(len(tsdf), rel=0.01)
    same = other.to_native()
    blocks, found = tsdf.blocks(), same.blocks()
    for kind in (True, False):
        a, b = ({tuple(c) for c in x.coordinates[x.dense == kind]} for x in (blocks, found))
        assert a and len(a ^ b) <= 0.01 * len(a)
    one, two = tsdf.read(blocks.coordinates), same.read(blocks.coordinates)
    seen = one.weight > 0
    assert ((two.weight > 0) == seen).mean() > 0.999
    for name, steps in {"value": 4, "weight": 2, "color": 1, "label": 0, "votes": 0}.items():
        difference = np.abs(getattr(one, name).astype(int) - getattr(two, name))[seen]
        assert (difference <= steps).mean() > 0.998, name


def test_torch_refuses_wrong_input_and_ignores_views_without_depth() -> None:
    tsdf, camera = TorchTsdf(), small_camera(40, 30)
    tsdf.integrate(np.zeros((30, 40), np.float32), camera, np.eye(4))
    assert len(tsdf) == 0 and len(tsdf.to_native()) == 0
    with pytest.raises(ValueError, match="depth"):
        tsdf.integrate(np.zeros((3, 4), np.float32), camera, np.eye(4))
