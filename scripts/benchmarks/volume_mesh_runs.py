# SPDX-License-Identifier: Apache-2.0
"""Mesh and depth rendering of a fused map against Open3D's VoxelBlockGrid. A part of bench_volumes.py."""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from timing import seconds
from volume_runs import Fusion, Ours, VoxelBlockGrid, frames_of, fuse_by_turns

from ggslam.evaluation.geometry import score_cloud
from ggslam.formats.triangle_mesh import TriangleMesh
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.volumes.mesh import extract_mesh
from ggslam.volumes.raycast import render_depth
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.surface_cells import SurfaceCells
from ggslam.volumes.tsdf import TsdfMap

REPEATS = 5
VIEWS = 10
"""Frames from whose poses depth is rendered."""
SAMPLES = 300_000
"""Points of a mesh that are scored."""


def reference_cloud(frames: Iterable[Frame], cell: float, min_depth: float, max_depth: float) -> np.ndarray:
    """Back-projected depth of frames with true poses, one measured point in each cube of `cell` metres, [N, 3]."""
    kept = np.empty((0, 3))
    for frame in frames:
        assert frame.T_world_camera is not None
        seen = (frame.depth > min_depth) & (frame.depth < max_depth)
        pose = frame.T_world_camera
        points = frame.camera.back_project(frame.depth)[seen].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        kept = np.concatenate([kept, _thinned(points, cell)])
        if len(kept) > 4_000_000:
            kept = _thinned(kept, cell)
    return _thinned(kept, cell)


def _thinned(points: np.ndarray, cell: float) -> np.ndarray:
    keys = np.floor(points / cell).astype(np.int64) + (1 << 20)
    _, first = np.unique((keys[:, 0] << 42) | (keys[:, 1] << 21) | keys[:, 2], return_index=True)
    return points[first]


def compare_meshes(path: Path, arguments: argparse.Namespace) -> None:
    """Fuses a recording with both and compares what they make of it."""
    frames = frames_of(path, arguments)
    kept = frames[:: max(1, len(frames) // VIEWS)][:VIEWS]
    for voxel in arguments.voxels:
        settings = TsdfSettings(voxel=voxel)
        maps: dict[str, Fusion] = {"ours": Ours(settings)}
        if importlib.util.find_spec("open3d"):
            maps["Open3D"] = VoxelBlockGrid(settings)
        fuse_by_turns(frames, maps)
        print(f"\n{path.name}, {len(frames)} frames, {100 * voxel:g} cm")
        ours, theirs = maps["ours"], maps.get("Open3D")
        assert isinstance(ours, Ours)
        reference = reference_cloud(frames, voxel / 4, settings.min_depth, settings.max_depth)
        grid = theirs.grid if isinstance(theirs, VoxelBlockGrid) else None
        poses = [frame.T_world_camera for frame in kept if frame.T_world_camera is not None]
        mesh_part(ours.tsdf, grid, frames[0].camera, poses, reference)
        rendering_error(ours.tsdf, kept)


def mesh_part(
    tsdf: TsdfMap, grid: Any, camera: Camera, poses: Sequence[np.ndarray], reference: np.ndarray | None = None
) -> None:
    """Prints times of mesh extraction and depth rendering, ours and Open3D's, and how well the meshes fit.

    Args:
        tsdf: a fused map.
        grid: open3d.t.geometry.VoxelBlockGrid of the same frames, with weight and colour; None: ours alone.
        camera: of the rendered images.
        poses: T_world_camera of the images that are rendered.
        reference: true points [N, 3]; None: meshes are not scored.
    """
    mesh = extract_mesh(tsdf)
    ours = min(seconds(lambda: (SurfaceCells(tsdf, tsdf.settings.least_weight), extract_mesh(tsdf)), REPEATS))
    print(f"  mesh: {len(mesh.triangles)} triangles in {1e3 * ours:.1f} ms", end="")
    theirs_mesh = None
    if grid is not None:
        theirs = min(seconds(lambda: grid.extract_triangle_mesh(0.0), REPEATS))
        theirs_mesh = _open3d_mesh(grid)
        print(f"; Open3D {len(theirs_mesh.triangles)} in {1e3 * theirs:.1f} ms; ratio {theirs / ours:.1f}", end="")
    print(flush=True)
    _print_rendering(tsdf, grid, camera, poses)
    if reference is not None:
        _print_score("ours", mesh.geometry(), reference, tsdf.settings.voxel)
        if theirs_mesh is not None:
            _print_score("Open3D", theirs_mesh, reference, tsdf.settings.voxel)


def _print_rendering(tsdf: TsdfMap, grid: Any, camera: Camera, poses: Sequence[np.ndarray]) -> None:
    near, far = tsdf.settings.min_depth, tsdf.settings.max_depth
    first = min(seconds(lambda: SurfaceCells(tsdf, tsdf.settings.least_weight), REPEATS))
    ours = np.mean([min(seconds(partial(render_depth, tsdf, camera, T, near, far), REPEATS)) for T in poses])
    print(f"  depth {camera.width}x{camera.height}: {1e3 * ours:.1f} ms, after a change of the map "
          f"{1e3 * first:.1f} ms more", end="")  # fmt: skip
    if grid is not None:
        import open3d

        core: Any = open3d.core
        keys = grid.hashmap().key_tensor()[grid.hashmap().active_buf_indices().to(core.Dtype.Int64)]
        K = core.Tensor(camera.matrix())

        def cast(T: np.ndarray) -> object:
            return grid.ray_cast(
                keys, K, core.Tensor(inverse(T)), camera.width, camera.height, ["depth", "normal", "color"],
                1.0, near, far, 1.0,
            )  # fmt: skip

        theirs = np.mean([min(seconds(partial(cast, T), REPEATS)) for T in poses])
        print(f"; Open3D {1e3 * theirs:.1f} ms; ratio {theirs / ours:.1f}", end="")
    print(flush=True)


def rendering_error(tsdf: TsdfMap, frames: Iterable[Frame]) -> None:
    """Prints how rendered depth differs from that of the frames that were fused, in voxels."""
    errors, missing = [], []
    for frame in frames:
        assert frame.T_world_camera is not None
        depth = render_depth(tsdf, frame.camera, frame.T_world_camera).depth
        known = (frame.depth > tsdf.settings.min_depth) & (frame.depth < tsdf.settings.max_depth)
        missing.append((depth[known] == 0).mean())
        errors.append((depth - frame.depth)[known & (depth > 0)] / tsdf.settings.voxel)
    error = np.concatenate(errors)
    print(f"  depth - true depth: median {np.median(error):+.3f}, mean {error.clip(-2, 2).mean():+.3f} (clipped to 2), "
          f"median size {np.median(np.abs(error)):.3f} voxels; missing {100 * np.mean(missing):.2f} %",
          flush=True)  # fmt: skip


def _open3d_mesh(grid: Any) -> TriangleMesh:
    mesh = grid.extract_triangle_mesh(0.0)
    vertices = mesh.vertex.positions.numpy().astype(np.float64)
    return TriangleMesh(vertices, mesh.triangle.indices.numpy().astype(np.int64))


def _print_score(name: str, mesh: TriangleMesh, reference: np.ndarray, voxel: float) -> None:
    scores = score_cloud(mesh.sample(SAMPLES)[0], reference, (voxel, 2 * voxel))
    near = scores.thresholds[0]
    print(f"  {name}: accuracy {1e3 * scores.accuracy_m:.2f} mm, completeness {1e3 * scores.completeness_m:.2f} mm; "
          f"within a voxel {100 * near.precision:.2f} % of the mesh; "
          f"missing {100 - 100 * near.recall:.2f} % of the reference, "
          f"{100 - 100 * scores.thresholds[1].recall:.2f} % within two",
          flush=True)  # fmt: skip
