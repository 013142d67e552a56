# SPDX-License-Identifier: Apache-2.0
"""A player in one process and a camera in another, over Zenoh and over DDS on 127.0.0.1."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags")

from ggslam.scene.frame import Frame
from ggslam.sequences import Sequence, open_sequence
from ggslam.sequences.formats.ros2_topics import Ros2Camera

LOOPBACK = (
    '<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface name="lo" multicast="true"/></Interfaces>'
    "</General></Domain></CycloneDDS>"
)


class Places:
    """How a player and a camera of one middleware find each other."""

    def __init__(self, middleware: str) -> None:
        pytest.importorskip({"zenoh": "zenoh", "dds": "cyclonedds"}[middleware])
        self.middleware = middleware
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.domain = 100 + self.port % 100

    def camera(self, more: str = "") -> Ros2Camera:
        address = f"&address=listen:tcp/127.0.0.1:{self.port}" if self.middleware == "zenoh" else ""
        query = f"middleware={self.middleware}&domain={self.domain}&wait=30{address}{more}"
        return Ros2Camera(f"ros2://camera/color,camera/depth?{query}")

    def play(self, recording: Path, *more: str) -> subprocess.Popen[str]:
        words = ["--middleware", self.middleware, "--domain", str(self.domain), *more]
        if self.middleware == "zenoh":
            words += ["--address", f"tcp/127.0.0.1:{self.port}"]
        command = [sys.executable, "-m", "ggslam", "play", str(recording), "--recorded-stamps", *words]
        environment = {**os.environ, "CYCLONEDDS_URI": LOOPBACK}
        return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


@pytest.fixture(params=["zenoh", "dds"])
def places(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Places:
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    return Places(request.param)


def check_equal(frames: list[Frame], sequence: Sequence) -> None:
    """Every frame is the recording's of that time, to the millimetre, in order."""
    times = [frame.timestamp for frame in frames]
    numbers = [int(np.argmin(np.abs(sequence.timestamps - time))) for time in times]
    assert numbers == sorted(set(numbers)) and times == pytest.approx(sequence.timestamps[numbers], abs=1e-9)
    for frame, number in zip(frames, numbers, strict=True):
        wanted = sequence.frame(number, masks=False)
        np.testing.assert_array_equal(frame.color, wanted.color)
        np.testing.assert_allclose(frame.depth, wanted.depth, atol=5.1e-4)


@pytest.mark.long("starts `ggslam play` twice, in processes of their own")
def test_frames_come_in_order_and_a_player_may_be_killed(room: Path, places: Places) -> None:
    """None is lost uncounted. The first player is killed; a second one is taken up by the same camera."""
    sequence = open_sequence(room)
    players = [places.play(room, "--fps", "20")]
    try:
        source = places.camera("&idle=20")
        said: list[str] = []
        source.follow(lambda: True, said.append)
        stream, frames = source.frames(), []
        for frame in stream:
            frames.append(frame)
            if len(frames) == 6:
                players[0].kill()
                players[0].wait(5)
                break
        check_equal(frames, sequence)
        players.append(places.play(room, "--fps", "20", "--start", "12"))
        second = []
        for frame in stream:
            if frame.timestamp > sequence.timestamps[11] + 1e-3:
                second.append(frame)
            if frame.timestamp > sequence.timestamps[-1] - 1e-3:
                break
        check_equal(second, sequence)
        out, _ = players[1].communicate(timeout=15)
        counts = source.counts()
        assert "sent 12 frames" in out and counts["damaged"] == 0
        assert counts["taken"] + counts["overwritten"] + counts["waiting"] == counts["pairs"] and len(second) >= 8
        assert counts["color"] + counts["depth"] == 2 * counts["pairs"] + counts["unmatched"]
        source.close()
    finally:
        for player in players:
            player.kill()
