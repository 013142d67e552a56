# SPDX-License-Identifier: Apache-2.0
"""The map while it grows, seen by a client that is none."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from ggslam.jobs.view.live import LiveView
from ggslam.sequences import open_sequence
from ggslam.slam.slam import Slam
from ggslam.viewer.server import close_server, open_server


class Camera:
    """Of a client; takes what it is given."""


class Client:
    camera = Camera()


@pytest.mark.parametrize("connected", [True, False])
def test_a_growing_map_is_shown_to_whom_looks(room: Path, connected: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("viser")
    server = open_server(port=0)
    monkeypatch.setattr(server, "get_clients", lambda: {0: Client()} if connected else {})
    live = LiveView(server, "room", max_splats=500)
    try:
        sequence = open_sequence(room)
        slam = Slam(sequence.camera)
        for frame in sequence.stream():
            live.follow(slam, frame, slam.step(frame))
            if frame.index == 2:
                break
        end = time.monotonic() + 30
        while connected and not live.updates and time.monotonic() < end:
            time.sleep(0.05)
        assert bool(live.updates) == connected
        shown: Any = server.scene.get_handle_by_name("/map/0")
        assert (shown is not None) == connected
        if connected:
            assert len(shown.buffer) == 500
    finally:
        live.close()
        close_server(server)
    assert not live._thread.is_alive()
