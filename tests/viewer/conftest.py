# SPDX-License-Identifier: Apache-2.0
"""A small run with objects to look at."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from ggslam.jobs.view.serve import serve_run
from ggslam.jobs.view.viewed_run import ViewedRun
from ggslam.runs.folder import RunFolder

from .browser import PATIENCE_S, messages, open_browser
from .page_hand import Hand

MAX_SPLATS = 4000
"""Drawn by the processor; the room's first frames have more."""


@pytest.fixture(scope="session")
def run(room_run: RunFolder) -> RunFolder:
    """Not to be changed."""
    return room_run


@pytest.fixture(scope="session")
def hand() -> Iterator[Hand]:
    """One browser for the tests of the page's tools."""
    browser = open_browser(1000, 700)
    browser.set_script_timeout(PATIENCE_S)
    yield Hand(browser)
    browser.quit()


@pytest.fixture
def served(hand: Hand, run: RunFolder, tmp_path: Path) -> Iterator[tuple[Hand, ViewedRun]]:
    """A hand on the page of a run of its own, served, and its model; the console is empty at the end."""
    own = RunFolder(Path(shutil.copytree(run.path, tmp_path / "run")))
    server, model = serve_run(own, port=0, max_splats=MAX_SPLATS)
    try:
        hand.open(server.address)
        yield hand, model
        assert messages(hand.browser) == []
    finally:
        hand.browser.get("about:blank")
        server.close()
        hand.browser.get_log("browser")  # a page whose server has ended says so
