# SPDX-License-Identifier: Apache-2.0
"""`ggslam render`: pictures of a run's map."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ggslam.cli import options
from ggslam.cli.console import console, progress_bar

EPILOG = """
[bold]Examples[/]

  ggslam render runs/kitchen --frames 0,50,100

  ggslam render runs/kitchen --what color,depth --every 5 --width 1280 --out pictures

  ggslam render runs/kitchen --what color,ids,pca

  ggslam render statue.sog --every 1
"""


def render(
    run: options.MapPath,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the pictures; default RUN/renders, or NAME_renders beside a file.")
    ] = None,
    frames: Annotated[str | None, typer.Option(help="Frames, e.g. 0,50,100; default: 8, spread evenly.")] = None,
    every: Annotated[int | None, typer.Option(help="Render every n-th frame instead.", min=1)] = None,
    what: Annotated[
        str, typer.Option(help="What to render: some of color, depth, alpha, ids, pca, separated by commas.")
    ] = "color,depth",
    width: Annotated[
        int | None, typer.Option(help="Width of the pictures; default: that of the run's images.", min=16, max=8192)
    ] = None,
) -> None:
    """Render a run's map from the poses of its frames; a file of Gaussians from 24 views around it."""
    from ggslam.jobs.render.frames import render_frames, select_frames
    from ggslam.runs.map_file import open_map

    folder = open_map(run)
    numbers = select_frames(folder, frames, every)
    with progress_bar() as bar:
        task = bar.add_task("render", total=len(numbers), info="")
        written = render_frames(
            folder, numbers, what.split(","), out or folder.output("renders"), width,
            progress=lambda done: bar.update(task, completed=done),
        )  # fmt: skip
    console.print(f"wrote {len(written)} pictures to {out or folder.path / 'renders'}", highlight=False, markup=False)
