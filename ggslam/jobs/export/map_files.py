# SPDX-License-Identifier: Apache-2.0
"""Objects of a run in files of their own, and the points of its surface."""

from __future__ import annotations

import dataclasses
from itertools import chain
from pathlib import Path

from ggslam.errors import ConfigError, InputError, RunFolderError
from ggslam.formats.writer import SurfacePoints
from ggslam.jobs.export.selection import ChosenGaussians, Prepare
from ggslam.objects.table import ObjectRecord
from ggslam.runs.folder import RunFolder
from ggslam.runs.objects_in_parts import ObjectsInParts
from ggslam.runs.opened_points import opened_points
from ggslam.scene.identity import IdentityClassifier
from ggslam.scene.object_names import object_file_name
from ggslam.system.atomic import make_folder, write_bytes
from ggslam.system.plurals import quantity

OBJECT_EXTRAS = ("object_id", "identity")
"""Properties of a 3DGS PLY that say which object a Gaussian belongs to."""


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
    return f"wrote {quantity(len(chosen), 'object')} to {path}: {quantity(total, 'Gaussian')}"


def _export_object(
    opaque: ChosenGaussians, path: Path, record: ObjectRecord, classifier: IdentityClassifier | None
) -> str:
    make_folder(path.parent)
    count = opaque.objects([record.id]).write(path, () if classifier is None else OBJECT_EXTRAS)
    if classifier is not None:
        _write_classifier(path, classifier)
    return f"wrote {record.label()} to {path}: {quantity(count, 'Gaussian')}"




def points_to_export(
    folder: RunFolder, voxel_size: float | None, discs: bool = False, min_opacity: float = 0.0
) -> SurfacePoints:
    """The points of a run's surface in clouds, at least one of them not empty.

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
    return SurfacePoints(first.voxel_size, chain([first], clouds))


def _write_classifier(ply: Path, classifier: IdentityClassifier) -> Path:
    path = ply.with_name(f"{ply.stem}_classifier.npz")
    write_bytes(path, classifier.to_bytes())
    return path
