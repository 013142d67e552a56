# SPDX-License-Identifier: Apache-2.0
"""Shows a run in a browser. What `ggslam view` does, usable from Python."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ggslam.jobs.view.live import LiveView
from ggslam.jobs.view.viewed_run import ViewedRun, ViewedRunTuning
from ggslam.runs.folder import RunFolder
from ggslam.system.atomic import make_folder, write_bytes
from ggslam.viewer.page import Page
from ggslam.viewer.server import DEFAULT_HOST, DEFAULT_PORT, address, clear_page, close_server, open_server

if TYPE_CHECKING:
    import viser


def serve_run(
    folder: RunFolder, host: str = DEFAULT_HOST, port: int = DEFAULT_PORT, max_splats: int = ViewedRunTuning.max_splats,
    sequence: Path | None = None, changes: Path | None = None,
) -> tuple[viser.ViserServer, ViewedRun]:  # fmt: skip
    """Serves a run's page until `close_server`.

    Args:
        folder: the run.
        host, port: see `open_server`.
        max_splats: show no more of the map's Gaussians.
        sequence: where the recording is now, if it was moved.
        changes: see `ViewedRun`.

    Raises:
        GgslamError: as `open_server` and `ViewedRun`.
    """
    model = ViewedRun(folder, max_splats, sequence, changes)
    server = open_server(host, port)
    try:
        show_run(server, model)
    except BaseException:
        close_server(server)
        raise
    return server, model


def show_run(server: viser.ViserServer, model: ViewedRun) -> None:
    """Shows a run on a server's page, in place of what was there."""
    clear_page(server)
    Page(server, model, model if model.has_objects else None, model.folder.path.resolve().name)


def write_page(
    folder: RunFolder, path: Path, max_splats: int = ViewedRunTuning.max_splats, sequence: Path | None = None
) -> tuple[ViewedRun, int]:
    """Writes a run's page as one HTML file that opens without server and network; returns the run and the file's
    size in bytes.

    Raises:
        GgslamError: as `ViewedRun`, or the file cannot be written.
    """
    model = ViewedRun(folder, max_splats, sequence)
    content = model.static_page(folder.path.resolve().name).encode()
    make_folder(path.parent)
    write_bytes(path, content)
    return model, len(content)


class LivePage:
    """A page that shows a run while it goes on and, afterwards, the run that was saved.

    Args:
        server: with an empty page.
        title: above the controls.
    """

    def __init__(self, server: viser.ViserServer, title: str) -> None:
        self._server, self._live = server, LiveView(server, title)
        self.follow = self._live.follow
        self.address = address(server)

    def show_result(self, folder: RunFolder) -> None:
        """Shows a saved run from now on."""
        self._live.close()
        show_run(self._server, ViewedRun(folder))


@contextmanager
def live_page(host: str = DEFAULT_HOST, port: int = DEFAULT_PORT, title: str = "ggslam") -> Iterator[LivePage]:
    """Serves a page for a run that is about to begin.

    Raises:
        GgslamError: as `open_server`.
    """
    server = open_server(host, port)
    try:
        yield LivePage(server, title)
    finally:
        close_server(server)


def wait_for_interrupt(announce: Callable[[], None]) -> None:
    """Says what is waited for, and returns at Ctrl-C, also if it comes while that is said."""
    try:
        announce()
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        pass
