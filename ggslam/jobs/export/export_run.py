# SPDX-License-Identifier: Apache-2.0
"""A run in the form that other programs take, in one call."""

from __future__ import annotations

from pathlib import Path

from ggslam.errors import ConfigError
from ggslam.jobs.export.map_files import (
    export_objects,
    export_points,
    export_segmented,
    export_splats,
    export_trajectory,
)
from ggslam.jobs.export.meshes import MeshRequest, export_mesh
from ggslam.jobs.export.splats import export_packed, export_pcd
from ggslam.jobs.export.views import export_colmap, export_nerfstudio
from ggslam.runs.folder import RunFolder

EXPORT_FORMATS = (
    "ply", "segmented", "compressed-ply", "spz", "splat", "points", "pcd", "mesh", "trajectory", "colmap", "nerfstudio",
)  # fmt: skip


def export_run(
    run: str | Path | RunFolder,
    out: str | Path,
    format: str = "ply",
    *,
    voxel: float | None = None,
    objects: str | None = None,
    min_opacity: float = 0.0,
    recording: str | Path | None = None,
) -> str:
    """Writes a run in a form that other programs take, as `ggslam export` does; returns a line that says what was
    written.

    Args:
        run: the run, or its folder.
        out: file or, for points, colmap, nerfstudio and for objects one by one, folder to write.
        format: ply: 3DGS Gaussians; segmented: the same in the colours of their objects; compressed-ply, spz, splat:
            the same in fewer bytes; points, pcd: coloured clouds; mesh: .glb, .obj or .ply; trajectory: TUM; colmap,
            nerfstudio: images with poses and points.
        voxel: metres: distance of points (default 0.01), or the edge of a mesh's voxels (default: as the run's
            settings say).
        objects: names or ids, "mug,7", or "all", for ply, segmented and mesh: only these.
        min_opacity: leave out fainter Gaussians (not of trajectory, mesh, colmap, nerfstudio).
        recording: where the recording is now, if it was moved (colmap, nerfstudio, mesh).

    Raises:
        ConfigError: an unknown format or object, or arguments that do not go together.
        MissingDependency: a package is needed for this format.
        RunFolderError: no run, a damaged one, or nothing to write.
        SequenceError: the recording cannot be read.
    """
    folder, place = run if isinstance(run, RunFolder) else RunFolder.open(Path(run)), Path(out)
    images = None if recording is None else Path(recording)
    if format not in EXPORT_FORMATS:
        raise ConfigError(f"export_run: unknown format {format!r}; known: {', '.join(EXPORT_FORMATS)}")
    if objects is not None and format not in ("ply", "segmented", "mesh"):
        raise ConfigError(f"export_run: objects goes with ply, segmented or mesh, not {format}")
    points = 0.01 if voxel is None else voxel
    if format == "ply" and objects is not None:
        return export_objects(folder, place, objects, min_opacity)
    if format == "ply":
        return export_splats(folder, place, min_opacity)
    if format == "segmented":
        return export_segmented(folder, place, objects, min_opacity)
    if format == "mesh":
        return export_mesh(folder, place, MeshRequest(voxel, objects, recording=images))
    if format in ("colmap", "nerfstudio"):
        write = export_colmap if format == "colmap" else export_nerfstudio
        return write(folder, place, points, recording=images)
    if format == "points":
        return export_points(folder, place, points, min_opacity)
    if format == "pcd":
        return export_pcd(folder, place, points, min_opacity)
    if format == "trajectory":
        return export_trajectory(folder, place)
    return export_packed(folder, place, format, min_opacity)
