# SPDX-License-Identifier: Apache-2.0
"""`ggslam view`: a run in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ggslam.cli import options
from ggslam.cli.console import console

EPILOG = """
[bold]Examples[/]

  ggslam view runs/kitchen

  ggslam view runs/kitchen --port 9000

  ggslam view runs/kitchen --html kitchen.html
"""


def view(
    run: options.RunPath,
    host: Annotated[
        str, typer.Option(help="Address to listen at; others than this machine reach e.g. 0.0.0.0.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen at; 0: any free one.")] = 8080,
    max_splats: Annotated[int, typer.Option(help="Show no more Gaussians, the most visible ones.", min=1000)] = 400_000,
    sequence: Annotated[Path | None, typer.Option(help="Where the recording is now, if it was moved.")] = None,
) -> None:
    """Look at a run in the browser: map, camera, frames; select, name, move, delete and export objects."""
    from ggslam.run_folder import RunFolder
    from ggslam.viewer.server import address, close_server
    from ggslam.viewing_jobs import serve_run, wait_for_interrupt

    server, model = serve_run(RunFolder.open(run), host, port, max_splats, sequence)
    for note in model.notes:
        console.print(f"note: {note}", highlight=False, markup=False, soft_wrap=True)
    console.print(f"{model.describe()}: {address(server)} (Ctrl-C ends)", highlight=False, markup=False, soft_wrap=True)
    wait_for_interrupt()
    close_server(server)
