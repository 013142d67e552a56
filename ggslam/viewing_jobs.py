# SPDX-License-Identifier: Apache-2.0
"""Shows a run in a browser. What `ggslam view` does, usable from Python."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from ggslam.run_folder import RunFolder
from ggslam.viewed_run import DEFAULT_SPLATS, ViewedRun
from ggslam.viewer.page import Page
from ggslam.viewer.server import DEFAULT_HOST, DEFAULT_PORT, close_server, open_server

if TYPE_CHECKING:
    import viser


def serve_run(
    folder: RunFolder, host: str = DEFAULT_HOST, port: int = DEFAULT_PORT, max_splats: int = DEFAULT_SPLATS,
    sequence: Path | None = None,
) -> tuple[viser.ViserServer, ViewedRun]:  # fmt: skip
    """Serves a run's page until `close_server`.

    Args:
        folder: the run.
        host, port: see `open_server`.
        max_splats: show no more of the map's Gaussians.
        sequence: where the recording is now, if it was moved.

    Raises:
        GgslamError: as `open_server` and `ViewedRun`.
    """
    server = open_server(host, port, "ggslam")
    try:
        model = ViewedRun(folder, max_splats, sequence)
        Page(server, model, model if model.has_objects else None, folder.path.resolve().name)
    except BaseException:
        close_server(server)
        raise
    return server, model


def wait_for_interrupt() -> None:
    """Returns at Ctrl-C."""
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        pass
