# SPDX-License-Identifier: Apache-2.0
"""`ggslam export`: a run's map in other forms."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from ggslam.cli import options
from ggslam.cli.console import console
from ggslam.errors import ConfigError

EPILOG = """
[bold]Examples[/]

  ggslam export runs/kitchen --format ply --out kitchen.ply

  ggslam export runs/kitchen --objects mug,7 --out objects/

  ggslam export runs/kitchen --format segmented --out kitchen_objects.ply

  ggslam export runs/kitchen --format points --voxel 0.005 --out clouds/

  ggslam export runs/kitchen --format trajectory --out kitchen.txt
"""


class ExportFormat(str, Enum):
    """What to write."""

    ply = "ply"
    segmented = "segmented"
    points = "points"
    trajectory = "trajectory"


def export(
    run: options.RunPath,
    out: Annotated[
        Path, typer.Option(help="File (ply, segmented, trajectory) or folder (points, ply with --objects) to write.")
    ],
    kind: Annotated[
        ExportFormat,
        typer.Option(
            "--format",
            help="ply: 3DGS Gaussians; segmented: the same in the colours of their objects; points: coloured clouds; "
            "trajectory: TUM.",
        ),
    ] = ExportFormat.ply,
    voxel: Annotated[float, typer.Option(help="Voxel size of points in metres.")] = 0.01,
    min_opacity: Annotated[float, typer.Option(help="Leave out fainter Gaussians (not for trajectory).")] = 0.0,
    objects: Annotated[
        str | None,
        typer.Option(help="Names or ids of objects, e.g. mug,7, or all. ply: one file each; segmented: only these."),
    ] = None,
    plain: Annotated[bool, typer.Option("--plain", help="Only the fields of 3DGS: no object ids, no identities.")] = (
        False
    ),
) -> None:
    """Export a run's map: Gaussians, single objects, coloured points, trajectory."""
    from ggslam.exporting import export_objects, export_points, export_segmented, export_splats, export_trajectory
    from ggslam.run_folder import RunFolder

    folder = RunFolder.open(run)
    if objects is not None and kind not in (ExportFormat.ply, ExportFormat.segmented):
        raise ConfigError(f"--objects goes with --format ply or segmented, not {kind.value}")
    if kind is ExportFormat.segmented:
        message = export_segmented(folder, out, objects, min_opacity, plain)
    elif kind is ExportFormat.ply and objects is not None:
        message = export_objects(folder, out, objects, min_opacity, plain)
    elif kind is ExportFormat.ply:
        message = export_splats(folder, out, min_opacity, plain)
    elif kind is ExportFormat.points:
        message = export_points(folder, out, voxel, min_opacity)
    else:
        message = export_trajectory(folder, out)
    console.print(message, highlight=False, markup=False)
