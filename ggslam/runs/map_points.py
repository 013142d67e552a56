# SPDX-License-Identifier: Apache-2.0
"""The coloured points of a run's map: what points.ply, exports and comparisons have."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from ggslam.formats.point_sampling import MapPart, sample_parts
from ggslam.formats.voxel_cloud import VoxelCloud
from ggslam.runs.map_index import MapInParts
from ggslam.runs.rendered_views import RenderedViews
from ggslam.system.tuning import Tuning
from ggslam.volumes.surface_points import SurfacePointTuning


class MapPointsTuning(Tuning):
    """How much of a surface is in memory."""

    few_blocks = 8_000
    """Blocks of the surface while a map is read cell by cell."""


def map_points(
    folder: Path, voxel_size: float | None = None, discs: bool = False, min_opacity: float = 0.3
) -> Iterator[VoxelCloud]:
    """The surface that a run's keyframes see of its map, in clouds one after the other, each with an origin of its own.

    Of a map without keyframes, and on request, they are the discs of its Gaussians, whether a keyframe sees them or
    not (see `formats.point_sampling`).

    Args:
        folder: of the run, whether it is complete yet or not.
        voxel_size: metres; None: as goes with the size of what the keyframes see.
        discs: take discs...
        min_opacity: ...of Gaussians that are at least this opaque.

    Raises:
        InputError: an impossible voxel size or opacity.
        RunFolderError, FormatError: a file is missing or damaged.
    """
    stored = MapInParts.of_folder(folder)
    return points_of_views(stored, RenderedViews.of_files(folder, stored), voxel_size, discs, min_opacity)


def points_of_views(
    stored: MapInParts, views: RenderedViews, voxel_size: float | None, discs: bool, min_opacity: float
) -> Iterator[VoxelCloud]:
    """As `map_points`, of a map and its views."""
    if stored.in_cells:
        parts = stored.parts()
    else:
        whole = stored.read(stored.cells())
        parts, views.in_view = [MapPart.of(whole)], lambda camera, T_camera_world: whole
    if discs or not len(views):
        return sample_parts(parts, voxel_size, min_opacity, views.segmented is not None)
    voxel_size = views.usual_voxel() if voxel_size is None else voxel_size
    most = MapPointsTuning.few_blocks if stored.in_cells else SurfacePointTuning.max_blocks
    return views.points(voxel_size, most)
