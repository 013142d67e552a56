# SPDX-License-Identifier: Apache-2.0
"""`ggslam export`: a run's map in other forms."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ggslam.cli import options
from ggslam.cli.console import console
from ggslam.errors import ConfigError

if TYPE_CHECKING:
    from ggslam.run_folder import RunFolder

EPILOG = """
[bold]Examples[/]

  ggslam export runs/kitchen --format ply --out kitchen.ply

  ggslam export runs/kitchen --objects mug,7 --out objects/

  ggslam export runs/kitchen --format segmented --out kitchen_objects.ply

  ggslam export runs/kitchen --format points --voxel 0.005 --out clouds/

  ggslam export runs/kitchen --format trajectory --out kitchen.txt

  ggslam export runs/kitchen --format spz --out kitchen.spz

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
    colmap = "colmap"
    nerfstudio = "nerfstudio"


_WITH_OBJECTS = (ExportFormat.ply, ExportFormat.segmented)
_WITH_VIEWS = (ExportFormat.colmap, ExportFormat.nerfstudio)


def export(
    run: options.RunPath,
    out: Annotated[
        Path,
        typer.Option(help="File or, for points, colmap, nerfstudio and ply with --objects, folder to write."),
    ],
    kind: Annotated[
        ExportFormat,
        typer.Option(
            "--format",
            help="ply: 3DGS Gaussians; segmented: the same in the colours of their objects; compressed-ply, spz, "
            "splat: the same in fewer bytes; points, pcd: coloured clouds; trajectory: TUM; colmap, nerfstudio: "
            "images with poses and points, to train on elsewhere.",
        ),
    ] = ExportFormat.ply,
    voxel: Annotated[float, typer.Option(help="Distance of points (points, pcd, colmap, nerfstudio), metres.")] = 0.01,
    min_opacity: Annotated[float, typer.Option(help="Leave out fainter Gaussians (not for trajectory).")] = 0.0,
    objects: Annotated[
        str | None,
        typer.Option(help="Names or ids of objects, e.g. mug,7, or all. ply: one file each; segmented: only these."),
    ] = None,
    plain: Annotated[bool, typer.Option("--plain", help="Only the fields of 3DGS: no object ids, no identities.")] = (
        False
    ),
    keyframes: Annotated[
        bool, typer.Option("--keyframes", help="colmap, nerfstudio: only keyframes and held-out frames.")
    ] = False,
    recording: Annotated[
        Path | None, typer.Option(help="colmap, nerfstudio: where the recording is now, if it was moved.")
    ] = None,
) -> None:
    """Export a run: Gaussians, single objects, coloured points, trajectory, images with poses."""
    from ggslam.run_folder import RunFolder

    folder = RunFolder.open(run)
    if objects is not None and kind not in _WITH_OBJECTS:
        raise ConfigError(f"--objects goes with --format ply or segmented, not {kind.value}")
    if (keyframes or recording is not None) and kind not in _WITH_VIEWS:
        raise ConfigError(f"--keyframes and --recording go with --format colmap or nerfstudio, not {kind.value}")
    if kind in _WITH_OBJECTS:
        message = _export_gaussians(folder, out, kind, objects, min_opacity, plain)
    elif kind in _WITH_VIEWS:
        message = _export_views(folder, out, kind, voxel, keyframes, recording)
    else:
        message = _export_plain(folder, out, kind, voxel, min_opacity)
    console.print(message, highlight=False, markup=False)


def _export_gaussians(
    folder: RunFolder, out: Path, kind: ExportFormat, objects: str | None, min_opacity: float, plain: bool
) -> str:
    from ggslam.exporting import export_objects, export_segmented, export_splats

    if kind is ExportFormat.segmented:
        return export_segmented(folder, out, objects, min_opacity, plain)
    if objects is not None:
        return export_objects(folder, out, objects, min_opacity, plain)
    return export_splats(folder, out, min_opacity, plain)


def _export_views(
    folder: RunFolder, out: Path, kind: ExportFormat, voxel: float, keyframes: bool, recording: Path | None
) -> str:
    from ggslam.view_exports import export_colmap, export_nerfstudio

    write = export_colmap if kind is ExportFormat.colmap else export_nerfstudio
    return write(folder, out, voxel, keyframes, recording)


def _export_plain(folder: RunFolder, out: Path, kind: ExportFormat, voxel: float, min_opacity: float) -> str:
    from ggslam.exporting import export_points, export_trajectory
    from ggslam.splat_exports import export_packed, export_pcd

    if kind is ExportFormat.points:
        return export_points(folder, out, voxel, min_opacity)
    if kind is ExportFormat.trajectory:
        return export_trajectory(folder, out)
    if kind is ExportFormat.pcd:
        return export_pcd(folder, out, voxel, min_opacity)
    return export_packed(folder, out, kind.value, min_opacity)
