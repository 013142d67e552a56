# SPDX-License-Identifier: Apache-2.0
"""A run's images with their poses, as formats of other people's trainers take them."""

from __future__ import annotations

from pathlib import Path

from ggslam.errors import RunFolderError
from ggslam.formats.nerfstudio import millimetres
from ggslam.formats.voxel_cloud import join_clouds
from ggslam.formats.writer import PosedView, PosedViews
from ggslam.jobs.export.map_files import points_to_export
from ggslam.reporting.pictures import write_picture
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.sequences import Sequence
from ggslam.system.atomic import make_folder


def posed_views(
    folder: RunFolder, voxel_size: float | None = 0.02, keyframes_only: bool = False, recording: Path | None = None
) -> PosedViews:
    """Images as the run saw them: undistorted, at its resolution; and points of its surface.

    Args:
        folder: of the run.
        voxel_size: distance of the points, metres; None: as `points_to_export` chooses.
        keyframes_only: leave out frames that are neither keyframes nor held out.
        recording: where the recording is now, if it was moved.

    Raises:
        ConfigError: impossible voxel size.
        RunFolderError: no frame was located, or the map has no points.
        SequenceError: the recording cannot be read.
    """
    views = _views(folder, keyframes_only)
    sequence = open_recording_of(folder, recording)
    cloud = join_clouds(points_to_export(folder, voxel_size).clouds)
    return PosedViews(lambda images, depth: _save(sequence, views, images, depth), cloud)


def _views(folder: RunFolder, keyframes_only: bool) -> dict[int, PosedView]:
    record, evaluation = folder.keyframes(), folder.config().evaluation
    keyframes = record.keyframe_numbers()
    read, views = folder.sequence(), {}
    for index, T_world_camera in sorted(record.poses().items()):
        held_out = evaluation.is_held_out(read.own_number(index)) and index not in keyframes
        if held_out or index in keyframes or not keyframes_only:
            views[index] = PosedView(index, T_world_camera, held_out, read.camera_of(index))
    if not views:
        raise RunFolderError(f"{folder.path}: no frame of this run was located")
    return views


def _save(sequence: Sequence, views: dict[int, PosedView], images: Path, depth: Path | None) -> list[PosedView]:
    """Writes the images one by one; gives the views whose frames could be read."""
    written = []
    make_folder(images)
    if depth is not None:
        make_folder(depth)
    for frame in sequence.stream(masks=False):
        view = views.get(frame.index)
        if view is None:
            continue
        write_picture(images / view.name, frame.color)
        if depth is not None:
            write_picture(depth / view.name, millimetres(frame.depth))
        written.append(view)
    return written
