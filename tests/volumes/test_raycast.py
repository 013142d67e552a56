# SPDX-License-Identifier: Apache-2.0
"""Depth rendered from a TSDF."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from volumes.field_maps import block_grid, box_room, field_map, plane, sphere, voxel_centers

from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, se3_exp
from ggslam.volumes.mesh import extract_mesh
from ggslam.volumes.raycast import RenderedSurface, render_depth
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import FREE_VALUE, FULL_WEIGHT, VOXELS, TsdfMap

VOXEL = 0.02
CAMERA = Camera(161, 123, 140, 138, 81.3, 60.2)
POSE = se3_exp(np.array([0.05, -0.08, -0.9, 0.06, -0.04, 0.7]))
"""Looks along z at the origin, rolled."""


def sphere_depth(radius: float, center: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Exact depth [H, W] of a sphere, 0 beside it."""
    rays = CAMERA.rays().astype(np.float64)
    middle = inverse(pose)[:3, :3] @ center + inverse(pose)[:3, 3]
    a, b, c = (rays**2).sum(-1), rays @ middle, middle @ middle - radius**2
    root = b**2 - a * c
    return np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 0)


def room_depth(half: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Exact depth [H, W] of a box seen from inside."""
    directions = CAMERA.rays() @ pose[:3, :3].T
    return np.min((np.where(directions > 0, half, -half) - pose[:3, 3]) / directions, -1)


@pytest.mark.parametrize("free_blocks", [True, False])
def test_sphere_is_seen_where_it_is(free_blocks: bool) -> None:
    center = np.array([0.013, -0.021, 0.004])
    surface = render_depth(field_map(sphere(0.3, tuple(center)), -3, 3, VOXEL, free_blocks), CAMERA, POSE)
    exact = sphere_depth(0.3, center, POSE)
    points = CAMERA.back_project(exact) @ POSE[:3, :3].T + POSE[:3, 3] - center
    facing = -(points * (CAMERA.rays() @ POSE[:3, :3].T)).sum(-1) / 0.3  # 0 at the rim
    safe = (exact > 0) & (facing > 0.3)
    assert safe.sum() > 3000 and (surface.depth[safe] > 0).all()
    assert (surface.depth[exact == 0] == 0).mean() > 0.995
    error = (surface.depth[safe] - exact[safe]) / VOXEL
    assert np.abs(error).max() < 0.1 and abs(error.mean()) < 0.02
    normals = surface.normals[safe] @ POSE[:3, :3].T
    assert ((normals * points[safe]).sum(-1) / 0.3 > np.cos(np.radians(4))).all()
    empty = surface.depth == 0
    assert not surface.normals[empty].any() and not surface.colors[empty].any()


def test_room_is_seen_from_inside() -> None:
    half = np.array([0.4, 0.31, 0.27])
    tsdf = field_map(box_room(tuple(half)), -3, 3, VOXEL)
    pose = se3_exp(np.array([0.1, 0.05, -0.1, 0.4, 0.7, -0.3]))
    surface, exact = render_depth(tsdf, CAMERA, pose), room_depth(half, pose)
    assert (surface.depth > 0).all()
    error = np.abs(surface.depth - exact) / VOXEL
    assert np.median(error) < 0.01 and np.quantile(error, 0.95) < 0.1 and error.mean() < 0.05  # edges are rounded


def test_plane_has_no_bias_at_any_offset() -> None:
    for offset in np.linspace(0, VOXEL, 7):  # at 0.01 voxel centres are on it
        surface = render_depth(field_map(plane(np.array([0, 0, -1.0]), offset), -3, 3, VOXEL), CAMERA, POSE)
        directions = (CAMERA.rays() @ POSE[:3, :3].T)[..., 2]
        exact = (-offset - POSE[2, 3]) / directions
        seen = surface.depth > 0
        assert seen.sum() > 5000
        assert np.abs(surface.depth - exact)[seen].max() < 0.01 * VOXEL


def test_surfaces_are_not_seen_from_behind() -> None:
    tsdf = field_map(plane(np.array([0, 0, 1.0]), 0.01), -3, 3, VOXEL)
    assert not render_depth(tsdf, CAMERA, POSE).depth.any()


def test_camera_between_the_blocks_and_range() -> None:
    """A camera beside blocks with surface, near and far."""
    tsdf = field_map(plane(np.array([0, 1.0, 0]), -0.1), -3, 3, VOXEL)  # a floor 10 cm below the camera
    up = np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1.0]])
    surface = render_depth(tsdf, CAMERA, up, near=0.05)
    v = np.arange(CAMERA.height)
    exact = 0.1 * CAMERA.fy / np.maximum(v - CAMERA.cy, 1e-9)
    rows = (exact > 0.06) & (exact < 0.4)
    middle = slice(75, 88)
    assert rows.sum() > 20
    assert np.abs(surface.depth[rows, middle] - exact[rows, None]).max() < 0.1 * VOXEL
    cut = render_depth(tsdf, CAMERA, up, near=0.25, far=0.3).depth
    assert (cut[cut > 0] >= 0.25).all() and (cut <= 0.3).all()
    inner = (exact > 0.26) & (exact < 0.29)
    assert inner.any() and (cut[inner, middle] > 0).all()
    with pytest.raises(ValueError, match="near"):
        render_depth(tsdf, CAMERA, up, near=1, far=0.5)
    with pytest.raises(ValueError, match="pose"):
        render_depth(tsdf, CAMERA, up * np.nan)


def test_unseen_voxels_have_no_surface() -> None:
    tsdf = field_map(plane(np.array([0, 0, -1.0]), 0.003), -3, 3, VOXEL)
    blocks = tsdf.blocks().coordinates[tsdf.blocks().dense]
    points = voxel_centers(blocks, VOXEL)
    tsdf.write(blocks, weight=np.where(points[..., 0] > 0.05, 0, FULL_WEIGHT))
    surface = render_depth(tsdf, CAMERA, POSE)
    x = (CAMERA.back_project(surface.depth) @ POSE[:3, :3].T + POSE[:3, 3])[..., 0]
    seen = surface.depth > 0
    assert seen.sum() > 3000 and x[seen].max() < 0.05 and x[seen].max() > 0.05 - 2.5 * VOXEL


def test_colors_and_objects() -> None:
    tsdf = field_map(sphere(0.3), -3, 3, VOXEL)
    blocks = tsdf.blocks().coordinates[tsdf.blocks().dense]
    points = voxel_centers(blocks, VOXEL)
    tsdf.write(blocks, label=np.where(points[..., 0] > 0, 7, 300))
    surface = render_depth(tsdf, CAMERA, POSE)
    seen = surface.depth > 0
    place = (CAMERA.back_project(surface.depth) @ POSE[:3, :3].T + POSE[:3, 3])[seen]
    assert np.abs(surface.colors[seen] - (1 + 253 * (place / (48 * VOXEL) + 0.5))).max() < 1.6
    clear = np.abs(place[:, 0]) > VOXEL
    assert np.array_equal(surface.labels[seen][clear], np.where(place[clear, 0] > 0, 7, 300))


def test_rendering_agrees_with_the_mesh() -> None:
    """The pixel of each vertex that faces the camera has the vertex's depth."""
    tsdf = field_map(sphere(0.3), -3, 3, VOXEL)
    surface, mesh = render_depth(tsdf, CAMERA, POSE), extract_mesh(tsdf)
    T = inverse(POSE)
    p, n = mesh.vertices @ T[:3, :3].T + T[:3, 3], mesh.normals @ T[:3, :3].T
    p = p[(p * n).sum(1) < -0.4 * np.linalg.norm(p, axis=1)]
    u = np.rint(CAMERA.fx * p[:, 0] / p[:, 2] + CAMERA.cx).astype(int)
    v = np.rint(CAMERA.fy * p[:, 1] / p[:, 2] + CAMERA.cy).astype(int)
    inside = (u >= 0) & (u < CAMERA.width) & (v >= 0) & (v < CAMERA.height)
    assert inside.sum() > 500
    assert np.abs(surface.depth[v[inside], u[inside]] - p[inside, 2]).mean() < 0.25 * VOXEL


def test_threads_do_not_matter_and_changes_are_seen() -> None:
    images: list[RenderedSurface] = []
    for threads in (1, 2):
        tsdf = field_map(box_room((0.4, 0.31, 0.27)), -3, 3, VOXEL, context=NativeContext(threads))
        images.append(render_depth(tsdf, CAMERA, np.eye(4)))
    for name in ("depth", "normals", "colors", "labels"):
        assert np.array_equal(getattr(images[0], name), getattr(images[1], name)), name
    tsdf.write_free(block_grid(-3, 3), np.full(216, FULL_WEIGHT))
    assert not render_depth(tsdf, CAMERA, np.eye(4)).depth.any()
    tsdf.clear()
    assert not render_depth(tsdf, CAMERA, np.eye(4)).depth.any()


def test_rays_end_where_the_interpolated_field_is_zero() -> None:
    """Random distances, whose field between eight voxels is far from linear."""
    tsdf, blocks = TsdfMap(TsdfSettings(voxel=VOXEL)), block_grid(-1, 1)
    value = np.random.default_rng(2).integers(-FREE_VALUE, FREE_VALUE, (len(blocks), VOXELS))
    tsdf.write(blocks, value=value, weight=np.full(value.shape, FULL_WEIGHT))
    field = np.empty((16, 16, 16))
    field[tuple(np.floor(voxel_centers(blocks, 1.0)).astype(int).reshape(-1, 3).T + 8)] = value.ravel()
    surface = render_depth(tsdf, CAMERA, POSE)
    seen = surface.depth > 0
    points = (CAMERA.back_project(surface.depth) @ POSE[:3, :3].T + POSE[:3, 3])[seen] / VOXEL + 7.5
    assert len(points) > 1000
    error = np.abs(map_coordinates(field, points.T, order=1)) / FREE_VALUE
    assert np.quantile(error, 0.99) < 0.001 and error.max() < 0.05
