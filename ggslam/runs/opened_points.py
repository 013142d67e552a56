# SPDX-License-Identifier: Apache-2.0
"""The coloured points of a run, or of a file of Gaussians, that was opened."""

from __future__ import annotations

from collections.abc import Iterator

from ggslam.formats.voxel_cloud import VoxelCloud
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_file import MapFile
from ggslam.runs.map_points import map_points, points_of_views
from ggslam.runs.objects_in_parts import ObjectsInParts
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.runs.rendered_views import RenderedViews


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
