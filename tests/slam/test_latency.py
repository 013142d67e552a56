# SPDX-License-Identifier: Apache-2.0
"""Delays from a picture to its pose and to the map."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.runs.records.timing import LatencyRecord
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.slam.latency import Delays, LatencyMeter

CAMERA = Camera(2, 2, 1.0, 1.0, 0.5, 0.5)


def frame(index: int) -> Frame:
    return Frame(index, index, index / 10, np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), np.float32), CAMERA)


def test_meter() -> None:
    clock = [100.0]
    meter = LatencyMeter(lambda f: float("nan") if f.index == 0 else 100.0 + f.index, lambda: clock[0])
    assert meter.pose() is None and meter.map() is None
    for index in range(5):
        clock[0] = 100.0 + index + 0.01 * index
        meter.pose_known(frame(index))
    clock[0] = 104.5
    meter.in_map(frame(4))
    assert meter.pose() == Delays(4, pytest.approx(0.025), pytest.approx(0.0385)) and meter.map() == Delays(1, 0.5, 0.5)
    counts = {"color": 9, "depth": 8, "pairs": 7, "taken": 5, "unmatched": 3, "overwritten": 2, "damaged": 1, "lost": 4}
    record = LatencyRecord.of_meter(meter, "stamp", counts, {"without a partner": 3})
    assert record.text() == (
        "latency since the picture's time stamp: pose 25 ms (95 %: 39 ms), map 500 ms (95 %: 500 ms); 7 pairs of 9 + 8 "
        "images, 5 taken, 2 overwritten; images: 3 unmatched, 1 damaged, 4 lost"
    )
    assert LatencyRecord.of_meter(meter, "due").text().startswith("latency since the frame was due: pose 25 ms")
    assert LatencyRecord.of(record.values()) == record
