# SPDX-License-Identifier: Apache-2.0
"""A run's map in other forms, made from blocks of its Gaussians or cell by cell."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import torch

from ggslam.errors import ConfigError, InputError, RunFolderError
from ggslam.formats.point_ply import write_points_in_parts
from ggslam.formats.trajectory import write_tum
from ggslam.formats.voxel_cloud import VoxelCloud
from ggslam.jobs.export.chosen import ChosenGaussians, Prepare
from ggslam.objects.table import ObjectRecord
from ggslam.runs.folder import RunFolder
from ggslam.runs.objects_in_parts import ObjectsInParts
from ggslam.runs.opened_points import opened_points
from ggslam.scene.gaussian_map import GaussianMap, rgb_to_sh
from ggslam.scene.identity import IdentityClassifier
from ggslam.scene.object_names import object_file_name
from ggslam.system.atomic import make_folder, write_bytes

OBJECT_EXTRAS = ("object_id", "identity")
"""Properties of a 3DGS PLY that say which object a Gaussian belongs to."""


def export_splats(
    folder: RunFolder, path: Path, min_opacity: float = 0.0, plain: bool = False, prepare: Prepare | None = None
) -> str:
    """Writes the Gaussians that are at least this opaque as a 3DGS PLY; returns a line that says so.

    A run with objects writes each Gaussian's object id and identity vector, too, and the classifier beside the file
    (`NAME_classifier.npz`), unless `plain`. `prepare` changes them first.
    """
    with_objects = folder.has_objects() and not plain
    chosen = ChosenGaussians.of(folder, folder.map_in_parts().rows, min_opacity, prepare=prepare)
    make_folder(path.parent)
    count = chosen.write(path, OBJECT_EXTRAS if with_objects else ())
    if not with_objects:
        return f"wrote {path}: {count} Gaussians"
    beside = _write_classifier(path, folder.classifier())
    return f"wrote {path}: {count} Gaussians with object ids and identities, and {beside.name}"


def export_objects(
    folder: RunFolder, path: Path, objects: str, min_opacity: float = 0.0, plain: bool = False,
    prepare: Prepare | None = None,
) -> str:  # fmt: skip
    """Writes each of some objects as a 3DGS PLY of its own (`ID_NAME.ply`), their lines of the table as objects.json
    and, unless `plain`, the classifier of the identities into the folder `path`; or a single object into the file
    `path`, with the classifier beside it. Returns a line that says so.

    Args:
        folder: of a run with objects.
        path: folder to write; or, if the name ends in .ply and is not that of a folder, the file of a single object.
        objects: names or ids, "mug,7", or "all".
        min_opacity: leave out fainter Gaussians.
        plain: leave out object ids and identities.
        prepare: changes the Gaussians first.

    Raises:
        ConfigError: an object is not there, or several are for one file.
        RunFolderError: the run has no objects, or the folder cannot be written.
    """
    scene = ObjectsInParts.of(folder)
    chosen = [scene.table.record(i) for i in scene.table.select(objects)]
    if not chosen:
        raise RunFolderError(f"{folder.path}: the run found no object; nothing to export")
    to_file = path.suffix.lower() == ".ply" and not path.is_dir()
    if to_file and len(chosen) > 1:
        raise ConfigError(
            f"`out` {path}: is the name of one file, but `objects` {objects} are {len(chosen)}, each with a file of "
            "its own: name a folder"
        )
    opaque, total = ChosenGaussians.of(folder, scene.map.rows, min_opacity, prepare=prepare), 0
    if to_file:
        return _export_object(opaque, path, chosen[0], None if plain else scene.classifier)
    make_folder(path)
    for record in chosen:
        own = path / object_file_name(record.id, record.name)
        total += opaque.objects([record.id]).write(own, () if plain else OBJECT_EXTRAS)
    dataclasses.replace(scene.table, objects=chosen).save(path / "objects.json")
    if not plain:
        _write_classifier(path / "map.ply", scene.classifier)
    return f"wrote {len(chosen)} object{'s' * (len(chosen) != 1)} to {path}: {total} Gaussians"


def _export_object(
    opaque: ChosenGaussians, path: Path, record: ObjectRecord, classifier: IdentityClassifier | None
) -> str:
    make_folder(path.parent)
    count = opaque.objects([record.id]).write(path, () if classifier is None else OBJECT_EXTRAS)
    if classifier is not None:
        _write_classifier(path, classifier)
    return f"wrote {record.label()} to {path}: {count} Gaussians"


def export_segmented(
    folder: RunFolder, path: Path, objects: str | None = None, min_opacity: float = 0.0, plain: bool = False,
    prepare: Prepare | None = None,
) -> str:  # fmt: skip
    """Writes a 3DGS PLY whose Gaussians keep their shapes and opacities but have the colours of their objects.

    Args:
        folder: of a run with objects.
        path: file to write; the classifier goes beside it, unless `plain`.
        objects: only these, as in `export_objects`; None: the whole map, unlabelled Gaussians in grey.
        min_opacity, plain, prepare: as in `export_objects`.

    Raises:
        ConfigError, RunFolderError: as in `export_objects`.
    """
    scene = ObjectsInParts.of(folder)
    ids = None if objects is None else scene.table.select(objects)
    chosen = ChosenGaussians.of(folder, scene.map.rows, min_opacity, ids, prepare)
    make_folder(path.parent)
    palette = torch.from_numpy(scene.table.palette())
    count = chosen.write(path, () if plain else OBJECT_EXTRAS, lambda part: _color_by_object(part, palette))
    if not plain:
        _write_classifier(path, scene.classifier)
    objects_written = len(scene.table) if ids is None else len(ids)
    return f"wrote {path}: {count} Gaussians in the colours of {objects_written} object{'s' * (objects_written != 1)}"


def _color_by_object(gaussians: GaussianMap, palette: torch.Tensor) -> None:
    """Gives each Gaussian the colour of its object, from all sides; unlabelled ones become grey."""
    gaussians.sh[:] = 0
    gaussians.sh[:, 0] = rgb_to_sh(palette[gaussians.object_id.long()].float() / 255)


def export_points(
    folder: RunFolder, path: Path, voxel_size: float | None, discs: bool = False, min_opacity: float = 0.0
) -> str:
    """Writes points.ply (metres) and points_grid.ply (integer cells) into the folder `path`; see `points_to_export`."""
    voxel_size, clouds = points_to_export(folder, voxel_size, discs, min_opacity)
    make_folder(path)
    count = write_points_in_parts(path, clouds)
    return f"wrote {path}/points.ply and points_grid.ply: {count} points on a {voxel_size:g} m grid"


def points_to_export(
    folder: RunFolder, voxel_size: float | None, discs: bool = False, min_opacity: float = 0.0
) -> tuple[float, Iterator[VoxelCloud]]:
    """The voxel size, and the points of a run's surface in clouds, at least one that is not empty.

    Args:
        folder: of the run.
        voxel_size: metres; None: 0.01, or more in scenes larger than rooms.
        discs: take the discs of the Gaussians instead, whether a keyframe sees them or not...
        min_opacity: ...that are at least this opaque; 0: 0.3.

    Raises:
        ConfigError: impossible voxel size or opacity.
        RunFolderError: the map has no points.
    """
    opacity = min_opacity if min_opacity > 0 else 0.3
    if not (voxel_size is None or voxel_size > 0) or not 0 < opacity < 1:
        raise ConfigError(f"impossible voxel size {voxel_size} or minimum opacity {opacity}")
    try:
        clouds = opened_points(folder, voxel_size, discs, opacity)
        first = next(clouds, None)
    except InputError as error:
        raise ConfigError(str(error)) from None
    if first is None:
        raise RunFolderError(f"{folder.path}: the map has no points to export")
    return first.voxel_size, chain([first], clouds)


def export_trajectory(folder: RunFolder, path: Path) -> str:
    """Writes the camera poses as a TUM trajectory."""
    trajectory = folder.trajectory()
    make_folder(path.parent)
    written = write_tum(path, trajectory.timestamps, trajectory.T_world_camera)
    return f"wrote {path}: {written} poses"


def _write_classifier(ply: Path, classifier: IdentityClassifier) -> Path:
    path = ply.with_name(f"{ply.stem}_classifier.npz")
    write_bytes(path, classifier.to_bytes())
    return path
