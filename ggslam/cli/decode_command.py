# SPDX-License-Identifier: Apache-2.0
"""`ggslam decode`: a G-PCC stream as a cloud or a map."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ggslam.cli import options
from ggslam.cli.console import console
from ggslam.errors import ConfigError
from ggslam.system.plurals import quantity

EPILOG = """
[bold]Examples[/]

  ggslam decode kitchen.bin kitchen.ply

  ggslam decode kitchen.bin corner.ply --box "0 0 0 1.5 1 2"

  ggslam decode kitchen.bin part.pcd --slice 2

  ggslam decode kitchen.ggz runs/kitchen

  ggslam decode house.ggc house.grid
"""


def decode(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="STREAM", help="Stream of the first edition of G-PCC, the .ggz of a run, or the .ggc of a store."
        ),
    ],
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            help="PLY or PCD file; for Gaussians a 3DGS PLY, for a .ggz a run folder, for a .ggc a grid store.",
        ),
    ],
    slice_id: Annotated[int | None, typer.Option("--slice", help="Decode only this slice.", min=0)] = None,
    box: Annotated[
        str | None, typer.Option(help='Decode only the points in this box: "x0 y0 z0 x1 y1 z1", metres.')
    ] = None,
    threads: options.Threads = None,
) -> None:
    """Decode an MPEG G-PCC stream, or one slice or box of it."""
    from ggslam.jobs.encode.coded_cells import is_cells_file
    from ggslam.jobs.encode.coding import decode_file
    from ggslam.runs.map_container import is_container

    if is_cells_file(source):
        return _unpack_cells(source, out, slice_id is not None or box is not None, threads)
    if is_container(source):
        _unpack(source, out, slice_id is not None or box is not None, threads)
        return
    corners = None if box is None else _corners(box)
    done = decode_file(source, out, slice_id, corners, threads)
    console.print(f"wrote {done.path}: {done.count} {done.what}", highlight=False, markup=False)


def _unpack(source: Path, out: Path, in_part: bool, threads: int | None) -> None:
    """A run folder from a container."""
    from ggslam.runs.map_container import read_container

    if in_part:
        raise ConfigError("--slice and --box are for streams; a .ggz is decoded as a whole")
    folder = read_container(source, out, threads=threads)
    console.print(
        f"wrote {folder.path}: a run of {quantity(folder.timing().gaussians or 0, 'Gaussian')}",
        highlight=False,
        markup=False,
    )


def _unpack_cells(source: Path, out: Path, in_part: bool, threads: int | None) -> None:
    """A grid store from a file of coded cells."""
    from ggslam.jobs.encode.coded_cells import decode_store

    if in_part:
        raise ConfigError("--slice and --box are for streams; a .ggc is decoded as a whole")
    count = decode_store(source, out, threads)
    console.print(f"wrote {out}: a grid store of {quantity(count, 'Gaussian')}", highlight=False, markup=False)


def _corners(text: str) -> tuple[list[float], list[float]]:
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if len(values) != 6 or not all(low <= high for low, high in zip(values[:3], values[3:], strict=True)):
        raise ConfigError(f'--box: expected "x0 y0 z0 x1 y1 z1" with x0 <= x1, y0 <= y1, z0 <= z1, found {text!r}')
    return values[:3], values[3:]
