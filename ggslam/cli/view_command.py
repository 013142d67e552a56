# SPDX-License-Identifier: Apache-2.0
"""`ggslam view`: a run in the browser."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ggslam.cli import options
from ggslam.cli.console import console
from ggslam.errors import ConfigError

if TYPE_CHECKING:  # torch is slow to import and `--help` does not need it
    from ggslam.jobs.view.store_page import StorePage
    from ggslam.jobs.view.viewed_run import ViewedRun
    from ggslam.viewer.page_server import PageServer

EPILOG = """
[bold]Examples[/]

  ggslam view runs/kitchen

  ggslam view runs/kitchen --port 9000

  ggslam view runs/kitchen --html kitchen.html --caption "The kitchen in May"

  ggslam view runs/monday --changes changes

  ggslam view statue.spz
"""


Viewed = Annotated[
    Path,
    typer.Argument(metavar="MAP", help="Folder that `ggslam run` wrote, file of Gaussians, or store of submaps."),
]


def view(
    run: Viewed,
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
    from ggslam.jobs.submaps.stores import is_store
    from ggslam.jobs.view.serve import serve_run, serve_store, write_page
    from ggslam.runs.map_file import open_map

    if is_store(run):
        if page is not None:
            raise ConfigError("--html: a store has no end; it can be served only")
        opened, store = serve_store(run, host, port, caption)
        return _wait(opened, lambda: _say(store, [], f"{opened.address} (Ctrl-C ends)"))
    folder = open_map(run)
    if page is not None:
        model, size = write_page(folder, page, max_splats, sequence, caption, changes)
        return _say(model, model.notes, f"wrote {page}: {size / 1e6:.1f} MB")
    server, model = serve_run(folder, host, port, max_splats, sequence, changes, caption)
    _wait(server, lambda: _say(model, model.notes, f"{server.address} (Ctrl-C ends)"))


def _wait(server: PageServer, announce: Callable[[], None]) -> None:
    from ggslam.jobs.view.serve import wait_for_interrupt

    try:
        wait_for_interrupt(announce)
    finally:
        server.close()


def _say(model: ViewedRun | StorePage, notes: list[str], text: str) -> None:
    for line in [*(f"note: {note}" for note in notes), model.describe(), text]:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
