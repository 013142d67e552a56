# SPDX-License-Identifier: Apache-2.0
"""Rays cast on a device against those of the compiled core, and against true depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from distance_scenes import block_range, box_room, sphere, union, write_scene
from test_cuda_tsdf import SETTINGS, TINY, views

from ggslam.cuda.library import CudaLibrary
from ggslam.scene.camera import Camera
from ggslam.scene.poses import se3_exp
from ggslam.volumes.cuda.raycast import CudaRaycast
from ggslam.volumes.cuda.tsdf import CudaTsdf
from ggslam.volumes.raycast import RenderedSurface, render_depth
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap

CAMERA = Camera(50, 37, 38.0, 37.5, 24.3, 18.2)
POSE = se3_exp(np.array([0.05, -0.08, -0.9, 0.06, -0.04, 0.7]))
"""Looks along z at the origin, rolled."""
VOXEL = 0.04


def assert_same(one: RenderedSurface, two: RenderedSurface) -> None:
    """Hits within a thousandth of a voxel, but for rays that graze an edge."""
    seen = (one.depth > 0) & (two.depth > 0)
    assert seen.sum() > 500 and ((one.depth > 0) != (two.depth > 0)).sum() <= 2
    off = np.abs(one.depth - two.depth)[seen]
    assert np.quantile(off, 0.99) < 1e-3 * VOXEL and (off > 0.1 * VOXEL).sum() <= 2
    assert np.quantile(np.abs(one.normals - two.normals)[seen], 0.99) < 1e-3
    assert np.quantile(np.abs(one.colors.astype(int) - two.colors)[seen], 0.99) <= 1
    assert (one.labels != two.labels)[seen].sum() <= 2


def test_exact_scenes_are_seen_where_they_are(cuda_library: CudaLibrary) -> None:
    tsdf = TsdfMap(TsdfSettings(voxel=VOXEL))
    ball = sphere((0.013, -0.021, 0.004), 0.3)
    room = box_room((-1.1, -1.03, -1.01), (1.07, 1.02, 1.04))
    write_scene(tsdf, union(ball, room), block_range((-1.3,) * 3, (1.3,) * 3, VOXEL))
    on_device = CudaTsdf.of_native(tsdf, library=cuda_library)
    cast = CudaRaycast(on_device)
    found = cast.read(cast.render(CAMERA, POSE))
    assert_same(render_depth(tsdf, CAMERA, POSE), found)
    rays = CAMERA.rays().reshape(-1, 3).astype(float) @ POSE[:3, :3].T
    at = POSE[:3, 3] - [0.013, -0.021, 0.004]
    a, b, c = (rays**2).sum(1), rays @ at, at @ at - 0.3**2
    root = b * b - a * c
    exact = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0).reshape(found.depth.shape)
    facing = (root > 0.5 * root.max()).reshape(exact.shape)
    error = np.abs(found.depth - exact)[facing]
    assert facing.sum() > 100 and error.max() < 0.1 * VOXEL  # 4 mm
    near = cast.read(cast.render(CAMERA, POSE, near=0.7, far=0.8)).depth
    assert near[near > 0].min() >= 0.7 and near.max() <= 0.8


def test_fused_views_are_seen_also_where_the_map_had_to_grow(cuda_library: CudaLibrary) -> None:
    seen = views(3)
    tsdf, other = TsdfMap(SETTINGS), CudaTsdf(SETTINGS, library=cuda_library, room=TINY)
    for view in seen:
        tsdf.integrate(*view)
        other.integrate(*view)
    cast = CudaRaycast(other)
    images = cast.render(seen[1][1], seen[1][2])
    found, expected = cast.read(images), render_depth(tsdf, seen[1][1], seen[1][2])
    both = (found.depth > 0) & (expected.depth > 0)
    assert both.mean() > 0.9 and ((found.depth > 0) == (expected.depth > 0)).mean() > 0.995
    assert np.quantile(np.abs(found.depth - expected.depth)[both], 0.98) < 1e-3  # a millimetre
    assert (found.labels == expected.labels)[both].mean() > 0.98


def test_weak_voxels_are_unknown_and_empty_maps_unseen(cuda_library: CudaLibrary) -> None:
    seen = views(2)
    other = CudaTsdf(replace(SETTINGS), library=cuda_library)
    cast = CudaRaycast(other)
    assert not cast.read(cast.render(seen[0][1], seen[0][2])).depth.any()
    other.integrate(*seen[0])
    assert cast.read(cast.render(seen[0][1], seen[0][2])).depth.any()
    assert not cast.read(cast.render(seen[0][1], seen[0][2], min_weight=16.0)).depth.any()
    with pytest.raises(ValueError, match="near"):
        cast.render(seen[0][1], seen[0][2], near=1, far=0.5)
