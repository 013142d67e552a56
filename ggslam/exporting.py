# SPDX-License-Identifier: Apache-2.0
"""A run's map in other forms."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import torch

from ggslam.errors import ConfigError, RunFolderError
from ggslam.formats.atomic import make_folder, write_bytes
from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.formats.point_ply import write_points
from ggslam.formats.point_sampling import sample_points
from ggslam.formats.trajectory import write_tum
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.objects.table import ObjectRecord
from ggslam.run_folder import RunFolder
from ggslam.scene.gaussian_map import GaussianMap, rgb_to_sh
from ggslam.scene.identity import IdentityClassifier

OBJECT_EXTRAS = ("object_id", "identity")
"""Properties of a 3DGS PLY that say which object a Gaussian belongs to."""


def export_splats(folder: RunFolder, path: Path, min_opacity: float = 0.0, plain: bool = False) -> str:
    """Writes the Gaussians that are at least this opaque as a 3DGS PLY; returns a line that says so.

    A run with objects writes each Gaussian's object id and identity vector, too, and the classifier beside the file
    (`NAME_classifier.npz`), unless `plain`.
    """
    gaussians = folder.gaussians()
    _drop_faint(folder, gaussians, min_opacity)
    make_folder(path.parent)
    if plain or not folder.has_objects():
        write_gaussian_ply(path, gaussians)
        return f"wrote {path}: {len(gaussians)} Gaussians"
    write_gaussian_ply(path, gaussians, OBJECT_EXTRAS)
    beside = _write_classifier(path, IdentityClassifier.from_file(folder.path / "classifier.npz"))
    return f"wrote {path}: {len(gaussians)} Gaussians with object ids and identities, and {beside.name}"


def export_objects(
    folder: RunFolder, path: Path, objects: str, min_opacity: float = 0.0, plain: bool = False
) -> str:  # fmt: skip
    """Writes each of some objects as a 3DGS PLY of its own (`ID_NAME.ply`), their lines of the table as objects.json
    and, unless `plain`, the classifier of the identities into the folder `path`; returns a line that says so.

    Args:
        folder: of a run with objects.
        path: folder to write.
        objects: names or ids, "mug,7", or "all".
        min_opacity: leave out fainter Gaussians.
        plain: leave out object ids and identities.

    Raises:
        ConfigError: an object is not there.
        RunFolderError: the run has no objects, or the folder cannot be written.
    """
    segmented = folder.segmented_map()
    chosen = [segmented.table.record(i) for i in segmented.table.select(objects)]
    if not chosen:
        raise RunFolderError(f"{folder.path}: the run found no object; nothing to export")
    _drop_faint(folder, segmented.gaussians, min_opacity)
    make_folder(path)
    total = 0
    for record in chosen:
        part = _part(segmented.gaussians, segmented.gaussians.object_id == record.id)
        write_gaussian_ply(path / object_file_name(record), part, () if plain else OBJECT_EXTRAS)
        total += len(part)
    dataclasses.replace(segmented.table, objects=chosen).save(path / "objects.json")
    if not plain:
        _write_classifier(path / "map.ply", segmented.classifier)
    return f"wrote {len(chosen)} objects to {path}: {total} Gaussians"


def export_segmented(
    folder: RunFolder, path: Path, objects: str | None = None, min_opacity: float = 0.0, plain: bool = False
) -> str:
    """Writes a 3DGS PLY whose Gaussians keep their shapes and opacities but have the colours of their objects.

    Args:
        folder: of a run with objects.
        path: file to write; the classifier goes beside it, unless `plain`.
        objects: only these, as in `export_objects`; None: the whole map, unlabelled Gaussians in grey.
        min_opacity, plain: as in `export_objects`.

    Raises:
        ConfigError, RunFolderError: as in `export_objects`.
    """
    segmented = folder.segmented_map()
    gaussians = segmented.gaussians
    if objects is not None:
        gaussians.keep(torch.isin(gaussians.object_id, torch.tensor(segmented.table.select(objects))))
    _drop_faint(folder, gaussians, min_opacity)
    make_folder(path.parent)
    write_gaussian_ply(path, colored_by_object(segmented), () if plain else OBJECT_EXTRAS)
    if not plain:
        _write_classifier(path, segmented.classifier)
    return f"wrote {path}: {len(gaussians)} Gaussians in the colours of {len(segmented.table)} objects"


def colored_by_object(segmented: SegmentedMap) -> GaussianMap:
    """The map with each Gaussian in the colour of its object, from all sides; unlabelled ones are grey."""
    gaussians = _part(segmented.gaussians, torch.ones(len(segmented.gaussians), dtype=torch.bool))
    rgb = torch.from_numpy(segmented.table.palette()[gaussians.object_id.numpy()]).float() / 255
    gaussians.sh[:] = 0
    gaussians.sh[:, 0] = rgb_to_sh(rgb)
    return gaussians


def object_file_name(record: ObjectRecord) -> str:
    """`7_mug.ply`, in characters that every file system takes."""
    name = re.sub(r"[^A-Za-z0-9-]+", "_", record.name or "").strip("_")[:64]
    return f"{record.id}_{name}.ply" if name else f"{record.id}.ply"


def export_points(folder: RunFolder, path: Path, voxel_size: float, min_opacity: float = 0.0) -> str:
    """Writes points.ply (metres) and points_grid.ply (integer cells) into the folder `path`."""
    try:
        opacity = min_opacity if min_opacity > 0 else 0.3
        cloud = sample_points(folder.gaussians(), voxel_size, opacity, with_object_id=folder.has_objects())
    except ValueError as error:
        raise ConfigError(str(error)) from None
    if not len(cloud):
        raise RunFolderError(f"{folder.path}: the map has no points to export")
    make_folder(path)
    write_points(path, cloud)
    return f"wrote {path}/points.ply and points_grid.ply: {len(cloud)} points on a {voxel_size} m grid"


def export_trajectory(folder: RunFolder, path: Path) -> str:
    """Writes the camera poses as a TUM trajectory."""
    trajectory = folder.trajectory()
    make_folder(path.parent)
    written = write_tum(path, trajectory.timestamps, trajectory.T_world_camera)
    return f"wrote {path}: {written} poses"


def _drop_faint(folder: RunFolder, gaussians: GaussianMap, min_opacity: float) -> None:
    if min_opacity > 0:
        gaussians.keep(gaussians.opacities >= min_opacity)
    if not len(gaussians):
        raise RunFolderError(f"{folder.path}: no Gaussian is at least {min_opacity} opaque; nothing to export")


def _part(gaussians: GaussianMap, selected: torch.Tensor) -> GaussianMap:
    """A copy of the Gaussians where `selected` (bool [N]) is true."""
    part = GaussianMap(gaussians.sh_degree, gaussians.features.shape[1], with_moments=False)
    rows = part.insert(
        gaussians.means[selected], gaussians.quaternions[selected], gaussians.log_scales[selected],
        gaussians.opacity_logits[selected], torch.zeros(int(selected.sum()), 3), gaussians.features[selected],
        object_id=gaussians.object_id[selected],
    )  # fmt: skip
    part.sh[rows] = gaussians.sh[selected]
    return part


def _write_classifier(ply: Path, classifier: IdentityClassifier) -> Path:
    path = ply.with_name(f"{ply.stem}_classifier.npz")
    write_bytes(path, classifier.to_bytes())
    return path
