# SPDX-License-Identifier: Apache-2.0
"""The map while it grows, asked for as a page does."""

from __future__ import annotations

import json
import struct
import time
from pathlib import Path

import pytest

from ggslam.jobs.view.live import LiveView
from ggslam.sequences import open_sequence
from ggslam.slam.slam import Slam
from ggslam.viewer.page_server import PageServer


@pytest.mark.parametrize("connected", [True, False])
def test_a_growing_map_is_shown_to_whom_looks(room: Path, connected: bool) -> None:
    server = PageServer(port=0)
    live = LiveView(server, "room", max_splats=500)
    heard = server._http.events.join() if connected else None
    try:
        assert server.source is live and live.scene()["waiting"] and not live.scene()["editable"]
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
        if heard is not None:
            news = json.loads((heard.next() or b"").decode().split("data: ")[1])
            assert {"camera", "splats"} <= set(news["what"]) and len(news["T_world_camera"]) == 16
            data = live.splats("map", 0)
            size = struct.unpack("<I", data[:4])[0]
            assert json.loads(data[4 : 4 + size])["count"] == 500
            scene = live.scene()
            assert scene["live"] and scene["keyframes"] and len(scene["path"][0]) >= 1 and "Top" in scene["views"]
            assert live.frame_picture(0)[:2] == b"\xff\xd8"
    finally:
        live.close()
        server.close()
    assert not live._thread.is_alive()
