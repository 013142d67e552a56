# SPDX-License-Identifier: Apache-2.0
"""A run's map for viewers and point cloud tools: packed splats, `.splat`, PCD."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from ggslam.errors import FormatError, RunFolderError
from ggslam.formats.compressed_ply import write_compressed_ply
from ggslam.formats.packed_splats import spz_packages, write_spz
from ggslam.formats.point_cloud import write_point_cloud
from ggslam.formats.splat_file import write_splat
from ggslam.formats.voxel_cloud import join_clouds
from ggslam.jobs.export.chosen import Prepare
from ggslam.jobs.export.map_files import points_to_export
from ggslam.runs.folder import RunFolder
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.atomic import make_folder

ENDINGS = {"compressed-ply": ".ply", "spz": ".spz", "spz4": ".spz", "splat": ".splat", "pcd": ".pcd"}
"""How a file of each kind is named, so that other programs know it."""


def export_packed(
    folder: RunFolder, path: Path, kind: str, min_opacity: float = 0.0, prepare: Prepare | None = None
) -> str:
    """Writes the Gaussians that are at least this opaque; returns a line that says so.

    Args:
        folder: of the run.
        path: file to write; its ending must be that of the kind.
        kind: "compressed-ply", "spz" (version 3), "spz4" (version 4) or "splat".
        min_opacity: leave out fainter Gaussians.
        prepare: changes the Gaussians first.

    Raises:
        FormatError: another ending.
        MissingDependency: the package that writes the format is not installed.
        RunFolderError: nothing to write, or the file cannot be written.
    """
    _check_ending(path, kind)
    if kind in ("spz", "spz4"):
        spz_packages(path, 4 if kind == "spz4" else 3)
    make_folder(path.parent)
    parts, left_out = _some(_parts(folder, min_opacity, kind != "splat", prepare), folder, min_opacity), ""
    if kind == "splat":
        count = write_splat(path, parts)
    else:
        gaussians = next(parts)
        count = len(gaussians)
        if kind == "compressed-ply":
            left_out = _left_out(write_compressed_ply(path, gaussians), gaussians.sh_degree)
        else:
            write_spz(path, gaussians, 4 if kind == "spz4" else 3)
    return f"wrote {path}: {count} Gaussians, {path.stat().st_size / 1e6:.1f} MB{left_out}"


def _left_out(written: int, degree: int) -> str:
    """What a compressed PLY has not, for people."""
    if written == degree:
        return ""
    which = f"degree {degree}" if written == degree - 1 else f"degrees {written + 1} to {degree}"
    return f"; left out colours of {which}: they are too faint for its steps of 1/32"


def export_pcd(
    folder: RunFolder, path: Path, voxel_size: float | None, discs: bool = False, min_opacity: float = 0.0
) -> str:
    """Writes the points of the surface, in metres, with colours, and with object ids if there are any, as PCD.

    Raises:
        ConfigError: impossible voxel size or opacity.
        FormatError: another ending than .pcd.
        RunFolderError: nothing to write, or the file cannot be written.
    """
    _check_ending(path, "pcd")
    voxel_size, clouds = points_to_export(folder, voxel_size, discs, min_opacity)
    cloud = join_clouds(clouds)
    attributes = {"color": cloud.colors}
    if cloud.object_id is not None:
        attributes["object_id"] = cloud.object_id
    make_folder(path.parent)
    write_point_cloud(path, cloud.points.astype("f4"), attributes)
    return f"wrote {path}: {len(cloud)} points on a {voxel_size:g} m grid"


def _check_ending(path: Path, kind: str) -> None:
    if path.suffix.lower() != ENDINGS[kind]:
        raise FormatError(f"{path}: a file of the format {kind} ends in {ENDINGS[kind]}")


def _parts(
    folder: RunFolder, min_opacity: float, whole: bool, prepare: Prepare | None
) -> Iterator[GaussianMap]:
    """The Gaussians that are opaque enough; unless `whole`, cell by cell where the map was written so."""
    stored = None if whole else folder.map_in_parts()
    maps = iter([folder.gaussians()]) if stored is None else (stored.read([cell]) for cell in stored.cells())
    for part in maps:
        if min_opacity > 0:
            part.keep(part.opacities >= min_opacity)
        if len(part):
            if prepare is not None:
                prepare(part)
            yield part


def _some(parts: Iterator[GaussianMap], folder: RunFolder, min_opacity: float) -> Iterator[GaussianMap]:
    """The same parts; raises RunFolderError if there are none."""
    first = next(parts, None)
    if first is None:
        raise RunFolderError(f"{folder.path}: no Gaussian is at least {min_opacity} opaque; nothing to export")
    return chain([first], parts)
