# SPDX-License-Identifier: Apache-2.0
"""A run's map in other forms, made from blocks of its Gaussians or cell by cell."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import chain
from pathlib import Path

import torch

from ggslam.errors import ConfigError, FormatError, RunFolderError
from ggslam.formats.gaussian_gltf import write_gaussian_gltf
from ggslam.formats.gaussian_ply import write_gaussian_parts
from ggslam.formats.gaussian_rows import GaussianRows
from ggslam.formats.point_ply import write_points_in_parts
from ggslam.formats.point_sampling import MapPart, sample_parts
from ggslam.formats.trajectory import write_tum
from ggslam.objects.table import ObjectRecord
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_index import MapInParts
from ggslam.runs.objects_in_parts import ObjectsInParts
from ggslam.scene.gaussian_map import GaussianMap, rgb_to_sh
from ggslam.scene.identity import IdentityClassifier
from ggslam.system.atomic import make_folder, write_bytes

OBJECT_EXTRAS = ("object_id", "identity")
"""Properties of a 3DGS PLY that say which object a Gaussian belongs to."""


def export_splats(folder: RunFolder, path: Path, min_opacity: float = 0.0, plain: bool = False) -> str:
    """Writes the Gaussians that are at least this opaque as a 3DGS PLY; returns a line that says so.

    A run with objects writes each Gaussian's object id and identity vector, too, and the classifier beside the file
    (`NAME_classifier.npz`), unless `plain`.
    """
    with_objects = folder.has_objects() and not plain
    chosen = _Chosen.of(folder, folder.map_in_parts().rows, min_opacity)
    make_folder(path.parent)
    count = chosen.write(path, OBJECT_EXTRAS if with_objects else ())
    if not with_objects:
        return f"wrote {path}: {count} Gaussians"
    beside = _write_classifier(path, IdentityClassifier.from_file(folder.path / "classifier.npz"))
    return f"wrote {path}: {count} Gaussians with object ids and identities, and {beside.name}"


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
    scene = ObjectsInParts.of(folder)
    chosen = [scene.table.record(i) for i in scene.table.select(objects)]
    if not chosen:
        raise RunFolderError(f"{folder.path}: the run found no object; nothing to export")
    opaque, total = _Chosen.of(folder, scene.map.rows, min_opacity), 0
    make_folder(path)
    for record in chosen:
        total += opaque.objects([record.id]).write(path / object_file_name(record), () if plain else OBJECT_EXTRAS)
    dataclasses.replace(scene.table, objects=chosen).save(path / "objects.json")
    if not plain:
        _write_classifier(path / "map.ply", scene.classifier)
    return f"wrote {len(chosen)} object{'s' * (len(chosen) != 1)} to {path}: {total} Gaussians"


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
    scene = ObjectsInParts.of(folder)
    ids = None if objects is None else scene.table.select(objects)
    chosen = _Chosen.of(folder, scene.map.rows, min_opacity, ids)
    make_folder(path.parent)
    palette = torch.from_numpy(scene.table.palette())
    count = chosen.write(path, () if plain else OBJECT_EXTRAS, lambda part: _color_by_object(part, palette))
    if not plain:
        _write_classifier(path, scene.classifier)
    return f"wrote {path}: {count} Gaussians in the colours of {len(scene.table)} objects"


def _color_by_object(gaussians: GaussianMap, palette: torch.Tensor) -> None:
    """Gives each Gaussian the colour of its object, from all sides; unlabelled ones become grey."""
    gaussians.sh[:] = 0
    gaussians.sh[:, 0] = rgb_to_sh(palette[gaussians.object_id.long()].float() / 255)


def export_gltf(
    folder: RunFolder, path: Path, objects: str | None = None, min_opacity: float = 0.0, plain: bool = False
) -> str:
    """Writes the Gaussians as binary glTF with KHR_gaussian_splatting; returns a line that says so.

    Args:
        folder: of the run.
        path: file to write; ends in .glb.
        objects: only these, as in `export_objects`; None: the whole map.
        min_opacity: leave out fainter Gaussians.
        plain: leave out object ids and names, which are written of runs with objects.

    Raises:
        ConfigError, RunFolderError: as in `export_objects`.
        FormatError: another ending, or what glTF cannot hold.
    """
    if path.suffix.lower() != ".glb":
        raise FormatError(f"{path}: a file of the format gltf ends in .glb")
    table = folder.object_table() if objects is not None or folder.has_objects() else None
    ids = None if table is None or objects is None else table.select(objects)
    rows = folder.map_in_parts().rows
    chosen = _Chosen.of(folder, rows, min_opacity, ids)
    names = None if table is None or plain else {i: table.record(i).name or "" for i in ids or table.ids()}
    make_folder(path.parent)
    write_gaussian_gltf(path, chosen.count, chosen.parts(), rows.like.sh_degree, names)
    found = "" if names is None else f" with the ids of {len(names)} object{'s' * (len(names) != 1)}"
    return f"wrote {path}: {chosen.count} Gaussians{found}, {path.stat().st_size / 1e6:.1f} MB"


def object_file_name(record: ObjectRecord) -> str:
    """`7_mug.ply`, in characters that every file system takes."""
    name = re.sub(r"[^A-Za-z0-9-]+", "_", record.name or "").strip("_")[:64]
    return f"{record.id}_{name}.ply" if name else f"{record.id}.ply"


def export_points(folder: RunFolder, path: Path, voxel_size: float, min_opacity: float = 0.0) -> str:
    """Writes points.ply (metres) and points_grid.ply (integer cells) into the folder `path`."""
    opacity, parts = min_opacity if min_opacity > 0 else 0.3, folder.map_in_parts()
    if not voxel_size > 0 or not 0 < opacity < 1:
        raise ConfigError(f"impossible voxel size {voxel_size} or minimum opacity {opacity}")
    make_folder(path)
    try:
        count = _sample(folder, parts, path, voxel_size, opacity)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    return f"wrote {path}/points.ply and points_grid.ply: {count} points on a {voxel_size} m grid"


def _sample(folder: RunFolder, parts: MapInParts, path: Path, voxel_size: float, opacity: float) -> int:
    """Writes the points of a map, cell by cell if it has cells; returns how many."""
    with_object_id = folder.has_objects()
    pieces = parts.parts() if parts.in_cells else [MapPart.of(folder.gaussians())]
    clouds = sample_parts(pieces, voxel_size, opacity, with_object_id)
    if (first := next(clouds, None)) is not None:
        return write_points_in_parts(path, chain([first], clouds))
    raise RunFolderError(f"{folder.path}: the map has no points to export")


def export_trajectory(folder: RunFolder, path: Path) -> str:
    """Writes the camera poses as a TUM trajectory."""
    trajectory = folder.trajectory()
    make_folder(path.parent)
    written = write_tum(path, trajectory.timestamps, trajectory.T_world_camera)
    return f"wrote {path}: {written} poses"


@dataclasses.dataclass(frozen=True)
class _Chosen:
    """Gaussians of a map on disk that are to be exported.

    Attributes:
        rows: the map.
        min_opacity: fainter ones are left out.
        ids: of the objects whose Gaussians are wanted; None: all.
        found: of each block of rows, how many are opaque enough, by object id.
    """

    rows: GaussianRows
    min_opacity: float
    ids: Sequence[int] | None
    found: Sequence[Counter[int]]

    @staticmethod
    def of(folder: RunFolder, rows: GaussianRows, min_opacity: float, ids: Sequence[int] | None = None) -> _Chosen:
        """Finds out how many there are; raises RunFolderError if there is none."""
        found = [Counter(b.object_id[b.opacities >= min_opacity].tolist()) for b in rows.blocks()]
        chosen = _Chosen(rows, min_opacity, ids, found)
        if not chosen.count:
            raise RunFolderError(f"{folder.path}: no Gaussian is at least {min_opacity} opaque; nothing to export")
        return chosen

    def objects(self, ids: Sequence[int]) -> _Chosen:
        """Those of some objects only."""
        return dataclasses.replace(self, ids=ids)

    @property
    def count(self) -> int:
        """How many there are."""
        return sum(map(self._count, self.found))

    def _count(self, found: Counter[int]) -> int:
        return found.total() if self.ids is None else sum(found[i] for i in self.ids)

    def write(
        self, path: Path, extra: Collection[str], change: Callable[[GaussianMap], None] = lambda part: None
    ) -> int:
        """Writes a 3DGS PLY of them, changed; returns how many there are."""
        write_gaussian_parts(path, self.count, self.parts(change), self.rows.like, extra)
        return self.count

    def parts(self, change: Callable[[GaussianMap], None] = lambda part: None) -> Iterator[GaussianMap]:
        """They themselves, block by block, changed."""
        for number, found in enumerate(self.found):
            if not self._count(found):
                continue
            part = self.rows.block(number)
            wanted = part.opacities >= self.min_opacity
            part.keep(wanted if self.ids is None else wanted & torch.isin(part.object_id, torch.tensor(self.ids)))
            change(part)
            yield part


def _write_classifier(ply: Path, classifier: IdentityClassifier) -> Path:
    path = ply.with_name(f"{ply.stem}_classifier.npz")
    write_bytes(path, classifier.to_bytes())
    return path
