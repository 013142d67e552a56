# SPDX-License-Identifier: Apache-2.0
"""`ggslam view`: a run in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ggslam.cli import options
from ggslam.cli.console import console

if TYPE_CHECKING:  # torch is slow to import and `--help` does not need it
    from ggslam.jobs.view.viewed_run import ViewedRun

EPILOG = """
[bold]Examples[/]

  ggslam view runs/kitchen

  ggslam view runs/kitchen --port 9000

  ggslam view runs/kitchen --html kitchen.html --caption "The kitchen in May"

  ggslam view runs/monday --changes changes

  ggslam view statue.spz
"""


def view(
    run: options.MapPath,
    host: options.Host = "127.0.0.1",
    port: options.Port = 8080,
    page: Annotated[
        Path | None,
        typer.Option(
            "--html", metavar="FILE", help="Write one HTML file that opens from disk instead of serving a page."
        ),
    ] = None,
    max_splats: Annotated[
        int, typer.Option(help="Most Gaussians to show; the most visible ones are chosen.", min=1000)
    ] = 400_000,
    sequence: options.MovedSequence = None,
    caption: Annotated[str, typer.Option(help="A line that is shown below the map.")] = "",
    changes: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="What `ggslam changes RUN NEWER --out FOLDER` wrote, to step through."),
    ] = None,
) -> None:
    """Look at a run in the browser: map, camera, frames; select, measure, edit, note, search, save what was edited."""
    from ggslam.jobs.view.serve import serve_run, wait_for_interrupt, write_page
    from ggslam.runs.map_file import open_map

    folder = open_map(run)
    if page is not None:
        model, size = write_page(folder, page, max_splats, sequence, caption, changes)
        _say(model, f"wrote {page}: {size / 1e6:.1f} MB")
        return
    server, model = serve_run(folder, host, port, max_splats, sequence, changes, caption)
    try:
        wait_for_interrupt(lambda: _say(model, f"{server.address} (Ctrl-C ends)"))
    finally:
        server.close()


def _say(model: ViewedRun, text: str) -> None:
    for line in [*(f"note: {note}" for note in model.notes), f"{model.describe()}", text]:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
