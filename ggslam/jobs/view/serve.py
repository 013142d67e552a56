# SPDX-License-Identifier: Apache-2.0
"""Shows a run in a browser. What `ggslam view` does, usable from Python."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ggslam.jobs.view.live import LiveView
from ggslam.jobs.view.packing import packed_rows
from ggslam.jobs.view.run_page import RunPage
from ggslam.jobs.view.store_page import StorePage
from ggslam.jobs.view.viewed_run import ViewedRun, ViewedRunTuning
from ggslam.runs.folder import RunFolder
from ggslam.system.atomic import make_folder, write_bytes
from ggslam.viewer.page_server import DEFAULT_HOST, DEFAULT_PORT, PageServer
from ggslam.viewer.page_text import file_page
from ggslam.viewer.scene_values import SceneValuesTuning, jpeg_address


def serve_run(
    folder: RunFolder, host: str = DEFAULT_HOST, port: int = DEFAULT_PORT, max_splats: int = ViewedRunTuning.max_splats,
    sequence: Path | None = None, changes: Path | None = None, caption: str = "",
) -> tuple[PageServer, ViewedRun]:  # fmt: skip
    """Serves a run's page until the server is closed.

    Args:
        folder: the run.
        host, port: see `PageServer`.
        max_splats: show no more of the map's Gaussians.
        sequence: where the recording is now, if it was moved.
        changes: see `ViewedRun`.
        caption: a line below the map.

    Raises:
        GgslamError: as `PageServer` and `ViewedRun`.
    """
    model = ViewedRun(folder, max_splats, sequence, changes)
    server = PageServer(host, port, _title(folder))
    server.show(RunPage(model, _title(folder), caption, server.tell))
    return server, model


def serve_store(
    path: Path, host: str = DEFAULT_HOST, port: int = DEFAULT_PORT, caption: str = ""
) -> tuple[PageServer, StorePage]:
    """Serves a page of a store of submaps until the server is closed.

    Raises:
        GgslamError: as `PageServer` and `StorePage`.
    """
    title = path.resolve().name
    page = StorePage(path, title, caption)
    server = PageServer(host, port, title)
    server.show(page)
    return server, page


def write_page(
    folder: RunFolder, path: Path, max_splats: int = ViewedRunTuning.max_splats, sequence: Path | None = None,
    caption: str = "", changes: Path | None = None,
) -> tuple[ViewedRun, int]:  # fmt: skip
    """Writes a run's page as one HTML file that opens without server and network; returns the run and the file's
    size in bytes.

    Raises:
        GgslamError: as `ViewedRun`, or the file cannot be written.
    """
    model = ViewedRun(folder, max_splats, sequence, changes)
    content = _file_page(model, _title(folder), caption).encode()
    make_folder(path.parent)
    write_bytes(path, content)
    return model, len(content)


def _file_page(model: ViewedRun, title: str, caption: str) -> str:
    scene = RunPage(model, title, caption).scene()
    header, splats = packed_rows(model, model.shown_rows())
    frames, most = scene["frames"], SceneValuesTuning.pictures_in_file
    shown = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, most).round().astype(int))]
    for frame in shown:
        frame["picture"] = jpeg_address(model.frame_picture(frame["frame"])[0])
    return file_page(title, {**scene, "served": False, "editable": False, "frames": shown, "splats": header}, splats)


def _title(folder: RunFolder) -> str:
    return folder.path.resolve().name


class LivePage:
    """A page that shows a run while it goes on and, afterwards, the run that was saved.

    Args:
        server: of the page.
        title: of the page.
    """

    def __init__(self, server: PageServer, title: str) -> None:
        self._server, self._live = server, LiveView(server, title)
        self.follow = self._live.follow
        self.address = server.address

    def show_result(self, folder: RunFolder) -> None:
        """Shows a saved run from now on."""
        self._live.close()
        self._server.show(RunPage(ViewedRun(folder), _title(folder), tell=self._server.tell))


@contextmanager
def live_page(host: str = DEFAULT_HOST, port: int = DEFAULT_PORT, title: str = "ggslam") -> Iterator[LivePage]:
    """Serves a page for a run that is about to begin.

    Raises:
        GgslamError: as `PageServer`.
    """
    server = PageServer(host, port, title)
    try:
        yield LivePage(server, title)
    finally:
        server.close()


def wait_for_interrupt(announce: Callable[[], None]) -> None:
    """Says what is waited for, and returns at Ctrl-C, also if it comes while that is said."""
    try:
        announce()
        while True:  # a signal that another thread of the process gets does not end a sleep of this one
            time.sleep(1.0)
    except KeyboardInterrupt:
        pass
