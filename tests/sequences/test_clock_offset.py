# SPDX-License-Identifier: Apache-2.0
"""The time between depth and colour is found from how the images move."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from app_recordings import PhoneFrame, phone_frames, write_scanner_app
from command_line import ggslam

from ggslam.sequences import open_sequence
from ggslam.sequences.clock_offset import measure_clock_offset

LATER_S = 0.6 / 60


@pytest.fixture(scope="module")
def frames() -> list[PhoneFrame]:
    """Colour is taken 10 ms after depth, in a walk that turns by 3.6 degrees a frame."""
    return phone_frames(12, (240, 180), (240, 180), frames=100, color_later=60 * LATER_S)


def test_colour_later_than_depth(tmp_path: Path, frames: list[PhoneFrame]) -> None:
    folder = write_scanner_app(tmp_path / "walk", frames, color_every=1)
    found = measure_clock_offset(open_sequence(folder))
    assert found is not None and found.seconds == pytest.approx(-LATER_S, abs=0.0015) and found.error < 0.003
    told = ggslam("inspect", folder).stdout
    assert "ms before colour (to" in told


@pytest.mark.long("a recording of its own is made")
def test_images_of_one_moment(tmp_path: Path) -> None:
    frames = phone_frames(12, (240, 180), (240, 180), frames=100)
    found = measure_clock_offset(open_sequence(write_scanner_app(tmp_path / "walk", frames, color_every=1)))
    assert found is not None and abs(found.seconds) < 0.0015


def test_depth_later_than_colour(tmp_path: Path, frames: list[PhoneFrame]) -> None:
    """Backwards in time what came later comes earlier."""
    again = [
        dataclasses.replace(frame, time=frames[0].time + k / 60) for k, frame in enumerate(reversed(frames))
    ]
    found = measure_clock_offset(open_sequence(write_scanner_app(tmp_path / "walk", again, color_every=1)))
    assert found is not None and found.seconds == pytest.approx(LATER_S, abs=0.0015)


def test_nothing_is_said_of_what_stands_still(tmp_path: Path, frames: list[PhoneFrame]) -> None:
    still = [dataclasses.replace(frames[0], time=7000 + k / 60) for k in range(10)]
    assert measure_clock_offset(open_sequence(write_scanner_app(tmp_path / "walk", still, color_every=1))) is None
    bare = [dataclasses.replace(frame, depth=np.full_like(frame.depth, 2)) for frame in frames]
    assert measure_clock_offset(open_sequence(write_scanner_app(tmp_path / "bare", bare, color_every=1))) is None
