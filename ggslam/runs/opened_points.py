# SPDX-License-Identifier: Apache-2.0
"""The coloured points of an opened run or file of Gaussians."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from ggslam.formats.voxel_cloud import VoxelCloud, join_clouds
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_file import MapFile, open_map
from ggslam.runs.map_points import map_points, points_of_views
from ggslam.runs.objects_in_parts import ObjectsInParts
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.runs.rendered_views import RenderedViews


def surface_points(run: str | Path | RunFolder, voxel_size: float | None = 0.01) -> VoxelCloud:
    """The surface that a run's keyframes see of its map: one coloured point for each voxel that it crosses, with object
    ids if there are any. Nothing but the run's folder is needed.

    Args:
        run: the run, or its folder; or a file of Gaussians, which gives discs unless it tells where it was seen from.
        voxel_size: metres, 0.001 to 1; None: 0.01, or more in scenes larger than rooms.

    Raises:
        VoxelError: voxels too small for what a keyframe sees.
        InputError: an impossible voxel size.
        RunFolderError, FormatError: a file is missing or damaged.
    """
    return join_clouds(opened_points(run if isinstance(run, RunFolder) else open_map(run), voxel_size))


def opened_points(
    run: RunFolder, voxel_size: float | None = None, discs: bool = False, min_opacity: float = 0.3
) -> Iterator[VoxelCloud]:
    """The points of a run; see `map_points`. A file that does not tell where its map was seen from gives discs.

    Raises:
        InputError: an impossible voxel size or opacity.
        RunFolderError, FormatError: a file is missing or damaged.
    """
    if not isinstance(run, MapFile):
        return map_points(run.path, voxel_size, discs, min_opacity)
    objects = ObjectsInParts.of(run) if run.has_objects() else None
    stored = run.map_in_parts() if objects is None else objects.map
    keyframes = run.keyframes() if run.has_poses else KeyframesRecord(keyframes=[], frames=[])
    segmented = None if objects is None else objects.around
    views = RenderedViews.of_records(run.sequence(), keyframes, stored, segmented)
    return points_of_views(stored, views, voxel_size, discs, min_opacity)
