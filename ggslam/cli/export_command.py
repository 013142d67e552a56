# SPDX-License-Identifier: Apache-2.0
"""`ggslam export`: a run's map in other forms."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ggslam.cli import options
from ggslam.cli.console import console, progress_bar
from ggslam.cli.export_formats import ExportFormat, choose_format
from ggslam.errors import ConfigError

if TYPE_CHECKING:
    from ggslam.runs.folder import RunFolder

EPILOG = """
[bold]Examples[/]

  ggslam export runs/kitchen --out kitchen.ply

  ggslam export runs/kitchen --out kitchen.glb

  ggslam export runs/kitchen --objects mug,7 --out objects/

  ggslam export runs/kitchen --format segmented --out kitchen_objects.ply

  ggslam export runs/kitchen --format points --voxel 0.005 --out clouds/

  ggslam export runs/kitchen --format nerfstudio --out kitchen_nerfstudio/
"""


_WITH_OBJECTS = (ExportFormat.ply, ExportFormat.segmented, ExportFormat.mesh)
_WITH_VIEWS = (ExportFormat.colmap, ExportFormat.nerfstudio)

OutPath = Annotated[
    Path,
    typer.Option(
        help="File to write; its name says the format (.ply .glb .obj .spz .splat .pcd .txt, .compressed.ply). A "
        "folder for points, colmap, nerfstudio, and for --objects with ply; with mesh, --objects takes either."
    ),
]
FormatName = Annotated[
    ExportFormat | None,
    typer.Option(
        "--format",
        help="ply: Gaussians as 3DGS stores them; segmented: the same in the colours of their objects; compressed-ply, "
        "spz, splat: the same in fewer bytes; points, pcd: coloured points; mesh: .glb, .obj or .ply; trajectory: "
        "TUM; colmap, nerfstudio: images, poses and points for other trainers. Default: what the name of --out says.",
    ),
]
Voxel = Annotated[
    float | None,
    typer.Option(help="Metres between points (points, pcd, colmap, nerfstudio; default 0.01), or the edge of a mesh's "
                 "voxels (default: volumes.tsdf.voxel of the run, 0.02)."),
]  # fmt: skip
MinOpacity = Annotated[float, typer.Option(help="Leave out fainter Gaussians (not for trajectory, mesh).")]
Objects = Annotated[
    str | None,
    typer.Option(help="Objects by name or id (mug,7), or all. ply: a file for each; segmented, mesh: only these."),
]
Plain = Annotated[bool, typer.Option("--plain", help="Write only the fields of 3DGS: no object ids, no identities.")]
Keyframes = Annotated[
    bool, typer.Option("--keyframes", help="colmap, nerfstudio: write only keyframes and held-out frames.")
]
Rendered = Annotated[
    bool,
    typer.Option("--rendered", help="mesh: fuse depth rendered from the map instead of the recording's. This is the "
                 "default where the recording is gone or the run was edited."),
]  # fmt: skip


def export(
    run: options.RunPath,
    out: OutPath,
    asked: FormatName = None,
    voxel: Voxel = None,
    min_opacity: MinOpacity = 0.0,
    objects: Objects = None,
    plain: Plain = False,
    keyframes: Keyframes = False,
    sequence: options.MovedSequence = None,
    rendered: Rendered = False,
) -> None:
    """Write a run's map, trajectory or images in a format that other programs read."""
    from ggslam.runs.folder import RunFolder

    folder = RunFolder.open(run)
    kind = choose_format(asked, out, objects)
    _refuse_ignored(kind, objects, keyframes, sequence, rendered)
    points = 0.01 if voxel is None else voxel
    if kind is ExportFormat.mesh:
        message = _export_mesh(folder, out, voxel, objects, rendered, sequence)
    elif kind in _WITH_OBJECTS:
        message = _export_gaussians(folder, out, kind, objects, min_opacity, plain)
    elif kind in _WITH_VIEWS:
        message = _export_views(folder, out, kind, points, keyframes, sequence)
    else:
        message = _export_plain(folder, out, kind, points, min_opacity)
    console.print(message, highlight=False, markup=False)


def _refuse_ignored(
    kind: ExportFormat, objects: str | None, keyframes: bool, sequence: Path | None, rendered: bool
) -> None:
    """Raises ConfigError for an option that this format leaves without effect."""
    if objects is not None and kind not in _WITH_OBJECTS:
        raise ConfigError(f"--objects goes with --format ply, segmented or mesh, not {kind.value}")
    if keyframes and kind not in _WITH_VIEWS:
        raise ConfigError(f"--keyframes goes with --format colmap or nerfstudio, not {kind.value}")
    if sequence is not None and kind not in (*_WITH_VIEWS, ExportFormat.mesh):
        raise ConfigError(f"--sequence goes with --format colmap, nerfstudio or mesh, not {kind.value}")
    if rendered and kind is not ExportFormat.mesh:
        raise ConfigError(f"--rendered goes with --format mesh, not {kind.value}")


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
    folder: RunFolder, out: Path, voxel: float | None, objects: str | None, rendered: bool, sequence: Path | None
) -> str:
    from ggslam.cli.observer import ProgressObserver
    from ggslam.jobs.export.meshes import MeshRequest, export_mesh

    with progress_bar() as bar:
        return export_mesh(folder, out, MeshRequest(voxel, objects, rendered, sequence), ProgressObserver(bar))


def _export_views(
    folder: RunFolder, out: Path, kind: ExportFormat, voxel: float, keyframes: bool, sequence: Path | None
) -> str:
    from ggslam.jobs.export.views import export_colmap, export_nerfstudio

    write = export_colmap if kind is ExportFormat.colmap else export_nerfstudio
    return write(folder, out, voxel, keyframes, sequence)


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
