# SPDX-License-Identifier: Apache-2.0
"""Our meshes beside Open3D's, both fused from the same exact depth images and measured against the exact surface."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
from analytic_scenes import Box, Scene, Sphere, Union, looking_at, render_depth, small_camera

from ggslam.formats.triangle_mesh import TriangleMesh
from ggslam.scene.poses import inverse
from ggslam.volumes.mesh import extract_mesh
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap

CAMERA = small_camera(320, 240)
ROOM = Box((-2.0, -1.2, -2.0), (2.0, 1.2, 2.0), inside_out=True)
SCENE = Union((ROOM, Sphere((0.3, 0.5, 0.4), 0.5), Box((-1.2, 0.2, -0.9), (-0.5, 1.2, -0.2))))
SAMPLES = 50_000


@pytest.fixture(scope="module")
def open3d() -> ModuleType:
    reason = "open3d cannot be imported (extra [bench], and the library libusb-1.0)"
    module: ModuleType = pytest.importorskip("open3d", reason=reason, exc_type=ImportError)
    return module


def walk() -> list[np.ndarray]:
    """Poses around the middle of the room, looking outwards and down."""
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    eyes = np.stack([0.9 * np.cos(angles), 0 * angles - 0.5, 0.9 * np.sin(angles)], 1)
    targets = [*(-eyes * [0.4, 0, 0.4] + [0, 0.5, 0]), *(eyes * [2.4, 0, 2.4] + [0, 0.4, 0])]
    return [looking_at(eye, target) for eye, target in zip([*eyes, *eyes], targets, strict=True)]


def millimetres(depth: np.ndarray) -> np.ndarray:
    """Depth as a sensor stores it, uint16."""
    return np.rint(1000 * depth).astype(np.uint16)


def our_mesh(views: list[tuple[np.ndarray, np.ndarray]], settings: TsdfSettings) -> TriangleMesh:
    tsdf = TsdfMap(settings)
    for depth, T in views:
        tsdf.integrate(depth.astype(np.float32) / 1000, CAMERA, T)
    mesh: TriangleMesh = extract_mesh(tsdf).geometry()
    return mesh


def their_mesh(o3d: Any, views: list[tuple[np.ndarray, np.ndarray]], settings: TsdfSettings) -> TriangleMesh:
    core, device = o3d.core, o3d.core.Device("CPU:0")
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1,), (1,)), settings.voxel, 16, 20000, device
    )
    for depth, T in views:
        image, intrinsics = o3d.t.geometry.Image(core.Tensor(depth)), core.Tensor(CAMERA.matrix())
        numbers = 1000.0, settings.max_depth, settings.truncation_voxels
        near = grid.compute_unique_block_coordinates(image, intrinsics, core.Tensor(inverse(T)), *numbers)
        grid.integrate(near, image, intrinsics, core.Tensor(inverse(T)), *numbers)
    mesh = grid.extract_triangle_mesh(0.0)
    return TriangleMesh(mesh.vertex.positions.numpy().astype(float), mesh.triangle.indices.numpy().astype(np.int64))


def errors(mesh: TriangleMesh, scene: Scene) -> np.ndarray:
    """Metres between points of a mesh and the surface."""
    return np.abs(scene.distance(mesh.sample(SAMPLES)[0]))


@pytest.mark.parametrize("voxel", [0.02, 0.05])
def test_our_mesh_is_nearer_to_the_surface_and_covers_as_much(open3d: ModuleType, voxel: float) -> None:
    settings = TsdfSettings(voxel=voxel)
    views = [(millimetres(render_depth(SCENE, CAMERA, T)), T) for T in walk()]
    ours, theirs = our_mesh(views, settings), their_mesh(open3d, views, settings)
    our_error, their_error = errors(ours, SCENE), errors(theirs, SCENE)
    assert our_error.mean() <= their_error.mean()
    assert (our_error < voxel / 2).mean() > 0.985
    assert area(ours) > 0.98 * area(theirs)


def area(mesh: TriangleMesh) -> float:
    """Of all triangles, square metres."""
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]] for corner in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)
