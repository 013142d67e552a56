# SPDX-License-Identifier: Apache-2.0
"""RealSense recordings and live cameras through a stand-in for the device, and live sources of one's own."""

from __future__ import annotations

import signal
import sys
import types
from collections.abc import Iterator
from pathlib import Path

import fake_realsense
import numpy as np
import pytest

from ggslam.errors import MissingDependency, SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.sequences import open_sequence, recognise_format
from ggslam.sequences.formats.realsense import _invert_distortion
from ggslam.sequences.live import LiveSequence, LiveSource, is_live, open_live


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", fake_realsense.module())


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    path = tmp_path / "desk.bag"
    path.write_bytes(b"#ROSBAG V2.0\n" + bytes(100) + b"/device_0/sensor_0/Depth_0/image/data")
    return path


@pytest.mark.usefixtures("device")
def test_playback(bag: Path) -> None:
    assert recognise_format(bag) == "realsense"
    sequence = open_sequence(bag)
    assert (sequence.name, sequence.format, len(sequence)) == ("desk", "realsense", 5) and sequence.registered
    assert sequence.depth_scale == pytest.approx(10000) and np.diff(sequence.timestamps) == pytest.approx(0.033)
    seen = [(round(float(f.color[12, 16, 0])), f.depth[12, 16]) for f in sequence.stream()]
    assert seen == [(10 * i, pytest.approx(1 + i / 10)) for i in range(5)]
    assert (sequence.frame(0).depth[12, 31] == 0).all()  # depth stands 5 cm to the left of colour
    assert [round(float(sequence.frame(i).depth[12, 16]), 1) for i in (3, 1, 4, 0)] == [1.3, 1.1, 1.4, 1.0]


def test_without_the_package(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(MissingDependency, match=r"pip install 'ggslam\[realsense\]'"):
        open_sequence(bag)


@pytest.mark.usefixtures("device")
def test_live_camera(tmp_path: Path) -> None:
    assert is_live("realsense:") and is_live("python:a:b") and not is_live("data/a:b") and not is_live("realsense")
    with pytest.raises(SequenceError, match="No device connected"):
        open_live("realsense:999")
    stopped = fake_realsense.Pipeline.stopped
    sequence = LiveSequence(open_live("realsense:123"), stop=3, record=tmp_path / "walk")
    frames = []
    for frame in sequence.stream():  # what came so far is a whole recording: a run may be killed
        frames.append(frame)
        assert len((tmp_path / "walk" / "timestamps.txt").read_text().splitlines()) == len(frames)
    assert [f.index for f in frames] == [0, 1, 2] and fake_realsense.Pipeline.stopped == stopped + 1
    again = open_sequence(tmp_path / "walk")
    assert len(again) == 3 and again.camera == sequence.camera
    np.testing.assert_allclose(again.frame(2).depth, frames[2].depth, atol=6e-4)
    np.testing.assert_array_equal(again.frame(2).color, frames[2].color)
    assert again.timestamps == pytest.approx(sequence._times)
    with pytest.raises(SequenceError, match="walk"):
        LiveSequence(open_live("realsense:"), record=tmp_path / "walk")


def test_inverse_lens_model() -> None:
    """Fitted coefficients undo the other direction's polynomial."""
    camera = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
    k1, k2, p1, p2, k3 = coefficients = np.array([-0.05, 0.06, 0.0005, -0.0004, -0.02])
    k = _invert_distortion(coefficients, camera)
    x, y = 0.4, -0.3  # distorted
    r = x * x + y * y
    f = 1 + k1 * r + k2 * r**2 + k3 * r**3
    u, v = x * f + 2 * p1 * x * y + p2 * (r + 2 * x * x), y * f + 2 * p2 * x * y + p1 * (r + 2 * y * y)
    r = u * u + v * v
    f = 1 + k[0] * r + k[1] * r**2 + k[4] * r**3
    back_x = u * f + 2 * k[2] * u * v + k[3] * (r + 2 * u * u)
    back_y = v * f + 2 * k[3] * u * v + k[2] * (r + 2 * v * v)
    assert np.abs(np.array([back_x - x, back_y - y])).max() * 600 < 0.1
    assert np.abs(np.array([u, v]) - (x, y)).max() * 600 > 1


class Webcam:
    """A source as a user would write it."""

    name, camera = "webcam", Camera(32, 24, 30.0, 30.0, 15.5, 11.5)

    def __init__(self) -> None:
        self.closed = False

    def frames(self) -> Iterator[Frame]:
        for i in range(1000):
            color, depth = np.full((24, 32, 3), i % 250, np.uint8), np.full((24, 32), 2.0, np.float32)
            yield Frame(i, i, i / 30, color, depth, self.camera)

    def close(self) -> None:
        self.closed = True


def test_source_of_ones_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "my_webcam", types.SimpleNamespace(Webcam=Webcam, number=lambda: 3))
    source = open_live("python:my_webcam:Webcam")
    assert isinstance(source, LiveSource) and isinstance(source, Webcam)
    count = 0
    before = signal.getsignal(signal.SIGINT)
    for frame in LiveSequence(source).stream():
        count += 1
        if frame.index == 4:
            signal.raise_signal(signal.SIGINT)  # Ctrl-C ends the stream after the frame in work, nothing is thrown away
    assert count == 5 and source.closed and signal.getsignal(signal.SIGINT) is before
    with pytest.raises(SequenceError, match="name, camera, frames"):
        open_live("python:my_webcam:number")
    with pytest.raises(SequenceError, match="python:MODULE:CALLABLE"):
        open_live("python:my_webcam:Nothing")
    with pytest.raises(SequenceError, match="python:MODULE:CALLABLE"):
        open_live("python:")
