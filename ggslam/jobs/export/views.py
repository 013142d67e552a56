# SPDX-License-Identifier: Apache-2.0
"""A run's images with their poses, for trainers of other people: COLMAP and nerfstudio folders."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ggslam.errors import RunFolderError
from ggslam.formats.colmap import write_colmap_model
from ggslam.formats.nerfstudio import TransformsFrame, millimetres, write_transforms
from ggslam.formats.point_ply import write_metric_points
from ggslam.formats.voxel_cloud import join_clouds
from ggslam.jobs.export.map_files import points_to_export
from ggslam.reporting.pictures import write_picture
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.scene.camera import Camera
from ggslam.sequences import Sequence
from ggslam.system.atomic import make_empty_folder, make_folder, write_text

IMAGES, DEPTHS, MODEL = "images", "depth", "sparse/0"


@dataclass(frozen=True)
class _View:
    """A frame that is exported: its index in the run, pose, whether it was kept away from training, and camera."""

    index: int
    T_world_camera: np.ndarray
    held_out: bool
    camera: Camera

    @property
    def name(self) -> str:
        return f"frame_{self.index:06d}.png"


@dataclass(frozen=True)
class _Views:
    sequence: Sequence
    views: list[_View]

    def summary(self) -> str:
        """For people."""
        held_out = sum(view.held_out for view in self.views)
        sizes = dict.fromkeys(f"{view.camera.width}x{view.camera.height}" for view in self.views)
        return f"{len(self.views)} images of {', '.join(sizes)} ({held_out} held out)"


def export_colmap(
    folder: RunFolder, out: Path, voxel_size: float | None = 0.02, keyframes_only: bool = False,
    recording: Path | None = None,
) -> str:  # fmt: skip
    """Writes `images/`, a sparse model `sparse/0/` in COLMAP's binary form and `sparse/0/test.txt`, the images that
    were held out; returns a line that says so.

    Images are as the run saw them: undistorted, at its resolution, PNG. Points are those of its surface.

    Args:
        folder: of the run.
        out: folder to write, new or empty.
        voxel_size: distance of the points, metres; None: as `points_to_export` chooses.
        keyframes_only: leave out frames that are neither keyframes nor held out.
        recording: where the recording is now, if it was moved.

    Raises:
        ConfigError: impossible voxel size.
        RunFolderError: no frame was located, the map has no points, or the folder cannot be written.
        SequenceError: the recording cannot be read.
    """
    views, cloud = _views(folder, keyframes_only, recording), join_clouds(points_to_export(folder, voxel_size)[1])
    make_empty_folder(out)
    make_folder(out / MODEL)
    written = list(_write_images(views, out, with_depth=False))
    write_colmap_model(
        out / MODEL, [v.camera for v in written], [v.name for v in written], [v.T_world_camera for v in written],
        cloud.points, cloud.colors,
    )  # fmt: skip
    write_text(out / MODEL / "test.txt", "".join(f"{v.name}\n" for v in written if v.held_out))
    return f"wrote {out}: {_Views(views.sequence, written).summary()}, {len(cloud)} points, COLMAP"


def export_nerfstudio(
    folder: RunFolder, out: Path, voxel_size: float | None = 0.02, keyframes_only: bool = False,
    recording: Path | None = None,
) -> str:  # fmt: skip
    """Writes `images/`, `depth/` (16 bit, millimetres), `points.ply` and `transforms.json`, which names the images to
    train on and those that were held out; returns a line that says so. Arguments and errors as in `export_colmap`."""
    views, cloud = _views(folder, keyframes_only, recording), join_clouds(points_to_export(folder, voxel_size)[1])
    make_empty_folder(out)
    written = list(_write_images(views, out, with_depth=True))
    write_metric_points(out / "points.ply", cloud)
    frames = [
        TransformsFrame(f"{IMAGES}/{v.name}", f"{DEPTHS}/{v.name}", v.T_world_camera, v.held_out, v.camera)
        for v in written
    ]
    write_transforms(out / "transforms.json", frames, "points.ply")
    return f"wrote {out}: {_Views(views.sequence, written).summary()} with depth, {len(cloud)} points, nerfstudio"


def _views(folder: RunFolder, keyframes_only: bool, recording: Path | None) -> _Views:
    record, evaluation = folder.keyframes(), folder.config().evaluation
    keyframes = record.keyframe_numbers()
    read, views = folder.sequence(), []
    for index, T_world_camera in sorted(record.poses().items()):
        held_out = evaluation.is_held_out(read.own_number(index)) and index not in keyframes
        if held_out or index in keyframes or not keyframes_only:
            views.append(_View(index, T_world_camera, held_out, read.camera_of(index)))
    if not views:
        raise RunFolderError(f"{folder.path}: no frame of this run was located")
    return _Views(open_recording_of(folder, recording), views)


def _write_images(views: _Views, out: Path, with_depth: bool) -> Iterator[_View]:
    """Writes the images one by one; gives the views whose frames could be read."""
    wanted = {view.index: view for view in views.views}
    make_folder(out / IMAGES)
    if with_depth:
        make_folder(out / DEPTHS)
    for frame in views.sequence.stream(masks=False):
        view = wanted.get(frame.index)
        if view is None:
            continue
        write_picture(out / IMAGES / view.name, frame.color)
        if with_depth:
            write_picture(out / DEPTHS / view.name, millimetres(frame.depth))
        yield view
