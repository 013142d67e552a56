# SPDX-License-Identifier: Apache-2.0
"""`ggslam export`: a run's map in other forms."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ggslam.cli import options
from ggslam.cli.console import console, progress_bar
from ggslam.errors import ConfigError

if TYPE_CHECKING:
    from ggslam.runs.folder import RunFolder

EPILOG = """
[bold]Examples[/]

  ggslam export runs/kitchen --format ply --out kitchen.ply

  ggslam export runs/kitchen --objects mug,7 --out objects/

  ggslam export runs/kitchen --format segmented --out kitchen_objects.ply

  ggslam export runs/kitchen --format points --voxel 0.005 --out clouds/

  ggslam export runs/kitchen --format trajectory --out kitchen.txt

  ggslam export runs/kitchen --format spz --out kitchen.spz

  ggslam export runs/kitchen --format mesh --out kitchen.glb      (or .obj, .ply)

  ggslam export runs/kitchen --format nerfstudio --out kitchen_nerfstudio/      (images, depth, poses, points)
"""


class ExportFormat(str, Enum):
    """What to write."""

    ply = "ply"
    segmented = "segmented"
    points = "points"
    trajectory = "trajectory"
    compressed_ply = "compressed-ply"
    spz = "spz"
    splat = "splat"
    pcd = "pcd"
    mesh = "mesh"
    colmap = "colmap"
    nerfstudio = "nerfstudio"


_WITH_OBJECTS = (ExportFormat.ply, ExportFormat.segmented, ExportFormat.mesh)
_WITH_VIEWS = (ExportFormat.colmap, ExportFormat.nerfstudio)


def export(
    run: options.RunPath,
    out: Annotated[
        Path,
        typer.Option(
            help="File or, for points, colmap, nerfstudio and ply with --objects, folder to write. mesh with "
            "--objects: a file that holds only these, or a folder for a PLY of each."
        ),
    ],
    kind: Annotated[
        ExportFormat,
        typer.Option(
            "--format",
            help="ply: 3DGS Gaussians; segmented: the same in the colours of their objects; compressed-ply, spz, "
            "splat: the same in fewer bytes; points, pcd: coloured clouds; mesh: .glb, .obj or .ply; trajectory: TUM; "
            "colmap, nerfstudio: images with poses and points, to train on elsewhere.",
        ),
    ] = ExportFormat.ply,
    voxel: Annotated[
        float | None,
        typer.Option(help="Metres: distance of points (points, pcd, colmap, nerfstudio; default 0.01); of mesh the "
                     "edge of its voxels (default: volumes.tsdf.voxel of the run, 0.02)."),
    ] = None,
    min_opacity: Annotated[float, typer.Option(help="Leave out fainter Gaussians (not for trajectory, mesh).")] = 0.0,
    objects: Annotated[
        str | None,
        typer.Option(help="Objects by name or id: mug,7, or all. ply: one file each; segmented, mesh: only these."),
    ] = None,
    plain: Annotated[bool, typer.Option("--plain", help="Only the fields of 3DGS: no object ids, no identities.")] = (
        False
    ),
    keyframes: Annotated[
        bool, typer.Option("--keyframes", help="colmap, nerfstudio: only keyframes and held-out frames.")
    ] = False,
    recording: Annotated[
        Path | None, typer.Option(help="colmap, nerfstudio, mesh: where the recording is now, if it was moved.")
    ] = None,
    rendered: Annotated[
        bool,
        typer.Option("--rendered", help="mesh: from depth rendered from the map, even if the recording is there. So it "
                     "is done anyway where the recording is gone or the run was edited."),
    ] = False,
) -> None:  # fmt: skip
    """Export a run: Gaussians, single objects, coloured points, a mesh, trajectory, images with poses."""
    from ggslam.runs.folder import RunFolder

    folder = RunFolder.open(run)
    if objects is not None and kind not in _WITH_OBJECTS:
        raise ConfigError(f"--objects goes with --format ply, segmented or mesh, not {kind.value}")
    if keyframes and kind not in _WITH_VIEWS:
        raise ConfigError(f"--keyframes goes with --format colmap or nerfstudio, not {kind.value}")
    if recording is not None and kind not in (*_WITH_VIEWS, ExportFormat.mesh):
        raise ConfigError(f"--recording goes with --format colmap, nerfstudio or mesh, not {kind.value}")
    if rendered and kind is not ExportFormat.mesh:
        raise ConfigError(f"--rendered goes with --format mesh, not {kind.value}")
    points = 0.01 if voxel is None else voxel
    if kind is ExportFormat.mesh:
        message = _export_mesh(folder, out, voxel, objects, rendered, recording)
    elif kind in _WITH_OBJECTS:
        message = _export_gaussians(folder, out, kind, objects, min_opacity, plain)
    elif kind in _WITH_VIEWS:
        message = _export_views(folder, out, kind, points, keyframes, recording)
    else:
        message = _export_plain(folder, out, kind, points, min_opacity)
    console.print(message, highlight=False, markup=False)


def _export_gaussians(
    folder: RunFolder, out: Path, kind: ExportFormat, objects: str | None, min_opacity: float, plain: bool
) -> str:
    from ggslam.jobs.export.map_files import export_objects, export_segmented, export_splats

    if kind is ExportFormat.segmented:
        return export_segmented(folder, out, objects, min_opacity, plain)
    if objects is not None:
        return export_objects(folder, out, objects, min_opacity, plain)
    return export_splats(folder, out, min_opacity, plain)


def _export_mesh(
    folder: RunFolder, out: Path, voxel: float | None, objects: str | None, rendered: bool, recording: Path | None
) -> str:
    from ggslam.cli.observer import ProgressObserver
    from ggslam.jobs.export.meshes import MeshRequest, export_mesh

    with progress_bar() as bar:
        return export_mesh(folder, out, MeshRequest(voxel, objects, rendered, recording), ProgressObserver(bar))


def _export_views(
    folder: RunFolder, out: Path, kind: ExportFormat, voxel: float, keyframes: bool, recording: Path | None
) -> str:
    from ggslam.jobs.export.views import export_colmap, export_nerfstudio

    write = export_colmap if kind is ExportFormat.colmap else export_nerfstudio
    return write(folder, out, voxel, keyframes, recording)


def _export_plain(folder: RunFolder, out: Path, kind: ExportFormat, voxel: float, min_opacity: float) -> str:
    from ggslam.jobs.export.map_files import export_points, export_trajectory
    from ggslam.jobs.export.splats import export_packed, export_pcd

    if kind is ExportFormat.points:
        return export_points(folder, out, voxel, min_opacity)
    if kind is ExportFormat.trajectory:
        return export_trajectory(folder, out)
    if kind is ExportFormat.pcd:
        return export_pcd(folder, out, voxel, min_opacity)
    return export_packed(folder, out, kind.value, min_opacity)
