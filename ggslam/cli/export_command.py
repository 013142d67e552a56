# SPDX-License-Identifier: Apache-2.0
"""`ggslam export`: a run's map in other forms."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from ggslam.cli import options
from ggslam.cli.console import console

EPILOG = """
[bold]Examples[/]

  ggslam export runs/kitchen --format ply --out kitchen.ply

  ggslam export runs/kitchen --format points --voxel 0.005 --out clouds/

  ggslam export runs/kitchen --format trajectory --out kitchen.txt
"""


class ExportFormat(str, Enum):
    """What to write."""

    ply = "ply"
    points = "points"
    trajectory = "trajectory"


def export(
    run: options.RunPath,
    out: Annotated[Path, typer.Option(help="File (ply, trajectory) or folder (points) to write.")],
    kind: Annotated[
        ExportFormat,
        typer.Option("--format", help="ply: 3DGS Gaussians; points: coloured clouds; trajectory: TUM."),
    ] = ExportFormat.ply,
    voxel: Annotated[float, typer.Option(help="Voxel size of points in metres.")] = 0.01,
    min_opacity: Annotated[float, typer.Option(help="Leave out fainter Gaussians (ply, points).")] = 0.0,
) -> None:
    """Export a run's map: Gaussians, coloured points, trajectory."""
    from ggslam.exporting import export_points, export_splats, export_trajectory
    from ggslam.run_folder import RunFolder

    folder = RunFolder.open(run)
    if kind is ExportFormat.ply:
        message = export_splats(folder, out, min_opacity)
    elif kind is ExportFormat.points:
        message = export_points(folder, out, voxel, min_opacity)
    else:
        message = export_trajectory(folder, out)
    console.print(message, highlight=False, markup=False)
