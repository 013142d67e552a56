# SPDX-License-Identifier: Apache-2.0
"""Points of a surface that depth images show: one for each voxel of a grid that the surface crosses.

The images are fused into a TSDF whose voxel centres are the corners of the grid's voxels. Where it changes its sign
marching cubes cut a grid voxel in triangles, and the point is the centroid of their area: errors of single images
average out, a surface that many views show gives one layer of points, and a point lies on the surface instead of in
the middle of its voxel (B. Curless and M. Levoy, 1996; W. Lorensen and H. Cline, 1987).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from ggslam.formats.pending_cubes import PendingCubes
from ggslam.formats.voxel_cloud import VoxelCloud, VoxelSums, cloud_of_sums, pack
from ggslam.geometry.scene_size import surface_reach
from ggslam.geometry.voxels import neighbour_step, voxel_keys
from ggslam.native.loader import NativeContext
from ggslam.system.tuning import Tuning
from ggslam.volumes.mesh import Mesh, extract_mesh
from ggslam.volumes.posed_view import PosedView
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import SIDE, TsdfMap


class SurfacePointTuning(Tuning):
    """How points of a surface are found."""

    truncation = 3.0
    """Voxels on either side of the surface that a view updates."""
    min_weight = 0.06
    """Smallest weight, in measurements from 1 m: what one view from 3 m gives a voxel halfway through its truncation. A
    larger one leaves a rim without points, a smaller one keeps points that only one view shows."""
    min_area = 0.1
    """Smallest area of surface in a voxel, in squared voxels: where a corner is cut off, the neighbours have the point.
    """
    cube_blocks = 4
    """Edge of the cubes that finished space is counted in, in blocks."""
    triangles_at_once = 50_000
    """Triangles whose points are held in memory at a time."""
    growth = 1.5
    """Growth of the blocks until finished ones are searched again."""
    max_blocks = 40_000
    """Blocks that are held before finished ones are handed out; 5 KB each."""


_NEIGHBOURS = np.array([neighbour_step(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)])


Look = Callable[[int, bool], PosedView]
"""Gives a view by its number; if coarse, at a fraction of the size, without colour and labels."""


def surface_points(
    look: Look, count: int, voxel_size: float, with_object_id: bool = False,
    most_blocks: int = SurfacePointTuning.max_blocks,
    context: NativeContext | None = None, times: float = 1.0,
) -> Iterator[VoxelCloud]:  # fmt: skip
    """The points of a surface, in clouds one after the other that have no voxel in common.

    Each view is looked at twice: coarsely, to see how far it reaches, and to be fused. What no view to come reaches is
    handed out and forgotten as soon as there are more than `most_blocks`; it pays to sort the views by where they are.

    Args:
        look: gives the views.
        count: their number.
        voxel_size: metres.
        with_object_id: whether the points carry object ids.
        most_blocks: see `SurfacePointTuning.max_blocks`.
        context: threads to work on.
        times: size of the scene against a room's, see `geometry.scene_size.voxel_times`: tells how far views are fused.

    Raises:
        VoxelError: voxels too small for what a view shows.
    """
    settings = surface_settings(voxel_size, times, SurfacePointTuning.truncation)
    of_view = [_cubes(look(k, True), voxel_size, settings.max_depth) for k in range(count)]
    sweep = _Sweep(TsdfMap(settings, context, points=False), of_view, SurfacePointTuning.min_weight / times**2)
    limit = most_blocks
    for number in range(count):
        sweep.add(number, look(number, False))
        if sweep.blocks > limit or number == count - 1:
            yield from sweep.take_finished(with_object_id)
            # Where little is finished, it pays to look rarely.
            limit = max(most_blocks, int(SurfacePointTuning.growth * sweep.blocks))


def surface_settings(voxel_size: float, times: float, truncation_voxels: float | None = None) -> TsdfSettings:
    """How depth is fused into a surface of points: voxels in metres, in a scene so many times a room's size."""
    usual = TsdfSettings()
    truncation = usual.truncation_voxels if truncation_voxels is None else truncation_voxels
    return replace(usual.of_size(times), voxel=voxel_size, max_depth=surface_reach(times), truncation_voxels=truncation)


def _cubes(view: PosedView, voxel_size: float, reach: float) -> np.ndarray:
    """The cubes that a view's surfaces within reach lie in, keys, each once."""
    near = replace(view, depth=np.where(view.depth <= reach, view.depth, np.float32(0)))
    return np.unique(voxel_keys(near.points(), voxel_size * SIDE * SurfacePointTuning.cube_blocks))


class _Sweep:
    """A TSDF that forgets what no view to come reaches."""

    def __init__(self, tsdf: TsdfMap, of_view: list[np.ndarray], least_weight: float) -> None:
        self._tsdf, self._to_come, self._least = tsdf, PendingCubes(of_view), least_weight
        self._handed_out = np.empty(0, np.int64)
        self._voxel = tsdf.settings.voxel

    @property
    def blocks(self) -> int:
        """With voxels."""
        return self._tsdf.dense_blocks

    def add(self, number: int, view: PosedView) -> None:
        """Fuses a view."""
        self._tsdf.integrate(view.depth, view.camera, view.T_world_camera, view.color, view.labels)
        self._to_come.is_done(number)

    def take_finished(self, with_object_id: bool) -> Iterator[VoxelCloud]:
        """The points of what is finished, which is forgotten when all were taken."""
        out = self._handed_out
        for cloud in _clouds_of(extract_mesh(self._tsdf, self._least), self._voxel, with_object_id):
            of_point = voxel_keys(
                cloud.grid + np.rint(cloud.origin / self._voxel), SIDE * SurfacePointTuning.cube_blocks
            )
            present = np.unique(of_point)
            ripe = present[self._all_around(present, self._to_come.are_done)]
            new = np.setdiff1d(ripe, out, assume_unique=True)
            self._handed_out = np.union1d(self._handed_out, new)
            cloud = _of_rows(cloud, np.isin(of_point, new))
            if len(cloud):
                yield cloud
        self._forget()

    def _all_around(self, cubes: np.ndarray, holds: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Whether something holds of cubes and of all their neighbours: a voxel's surface is made of voxels beside
        it."""
        return np.all([holds(cubes + step) for step in _NEIGHBOURS], axis=0)

    def _forget(self) -> None:
        """Blocks that no cube to be handed out needs go."""
        at = self._tsdf.blocks().coordinates
        cubes = voxel_keys(at, SurfacePointTuning.cube_blocks)
        present = np.unique(cubes)
        needless = self._all_around(present, lambda keys: self._to_come.are_done(keys) & self._is_out(keys, present))
        self._tsdf.erase(at[np.isin(cubes, present[needless])])

    def _is_out(self, cubes: np.ndarray, present: np.ndarray) -> np.ndarray:
        return np.isin(cubes, self._handed_out) | ~np.isin(cubes, present)


def _clouds_of(mesh: Mesh, voxel: float, with_object_id: bool) -> Iterator[VoxelCloud]:
    """One point for each voxel of the grid that triangles lie in: those of marching cubes lie in one each, and all of a
    voxel follow one another."""
    labels = mesh.triangle_labels().astype(np.int32) if with_object_id else np.zeros(len(mesh.triangles), np.int32)
    start = 0
    while start < len(mesh.triangles):
        keys, centroid, area = _triangles(mesh, start, start + SurfacePointTuning.triangles_at_once, voxel)
        if start + SurfacePointTuning.triangles_at_once < len(
            mesh.triangles
        ):  # the last voxel may go on in the next chunk
            others = np.flatnonzero(keys != keys[-1])
            count = int(others[-1]) + 1 if len(others) else len(keys)
        else:
            count = len(keys)
        part, weight = slice(start, start + count), area[:count, None]
        color = mesh.colors[mesh.triangles[part]].mean(1) / 255
        sums = VoxelSums(keys[:count], labels[part], area[:count], weight * color, weight * centroid[:count])
        yield cloud_of_sums(VoxelSums.of([sums]), voxel, with_object_id, SurfacePointTuning.min_area * voxel**2)
        start += count


def _triangles(mesh: Mesh, start: int, stop: int, voxel: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Voxels (packed, [n]), centroids [n, 3] and areas [n] of some triangles."""
    corners = mesh.vertices[mesh.triangles[start:stop]].astype(np.float64)
    centroid, (first, second) = corners.mean(1), np.moveaxis(corners[:, 1:] - corners[:, :1], 1, 0)
    area = np.linalg.norm(np.cross(first, second), axis=1) / 2
    return pack(np.rint(centroid / voxel).astype(np.int64)), centroid, area


def _of_rows(cloud: VoxelCloud, chosen: np.ndarray) -> VoxelCloud:
    """Some of the points, bool [N], on the same grid."""
    ids = None if cloud.object_id is None else cloud.object_id[chosen]
    offsets = None if cloud.offsets is None else cloud.offsets[chosen]
    return replace(cloud, grid=cloud.grid[chosen], colors=cloud.colors[chosen], object_id=ids, offsets=offsets)
