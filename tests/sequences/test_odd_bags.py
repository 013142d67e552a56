# SPDX-License-Identifier: Apache-2.0
"""Bags as drivers write them that do not keep to their own rules: exact values come out, or one clear error."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import ggslam, refuse, succeed
from image_bags import (
    COLOR_TOPIC,
    LAYOUTS,
    ImageMessages,
    _write,
    as_png,
    depth_mm,
    picture,
    write_image_bag,
)

from ggslam.errors import SequenceError
from ggslam.sequences import inspect_sequence, open_sequence

STORAGES = ("ros1", "mcap")


def color(messages: ImageMessages, time: float, i: int) -> Any:
    return messages.raw_image(time, "rgb8", LAYOUTS["rgb8"](picture(i)))


def depth(messages: ImageMessages, time: float, i: int) -> Any:
    return messages.raw_image(time, "16UC1", depth_mm(i))


def depth_in_metres(messages: ImageMessages, time: float, i: int) -> Any:
    return messages.raw_image(time, "32FC1", np.where(depth_mm(i) > 0, depth_mm(i) / 1000, np.nan).astype(np.float32))


def largest_error_mm(path: Path) -> float:
    frames = list(open_sequence(path))
    assert len(frames) == 3
    return max(float(np.abs(1000.0 * frame.depth - depth_mm(i)).max()) for i, frame in enumerate(frames))


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("first", [depth, depth_in_metres])
def test_the_unit_of_depth_changes_midway(tmp_path: Path, storage: str, first: Any) -> None:
    """The first message is of one encoding, the others of the other: depth is right to a hundredth of a millimetre."""
    then = depth_in_metres if first is depth else depth
    path = write_image_bag(tmp_path, storage, color, lambda m, t, i: (then if i else first)(m, t, i))
    assert largest_error_mm(path) < 0.01


@pytest.mark.parametrize("storage", STORAGES)
def test_headers_without_times(tmp_path: Path, storage: str) -> None:
    """They are those of the recording then, 1/30 s apart."""
    path = write_image_bag(tmp_path, storage, lambda m, t, i: color(m, 0.0, i), lambda m, t, i: depth(m, 0.0, i))
    sequence = open_sequence(path)
    np.testing.assert_allclose(np.diff(sequence.timestamps), 1 / 30, atol=1e-6)
    assert largest_error_mm(path) == pytest.approx(0, abs=1e-3)
    told = succeed("inspect", path)
    assert "at 30.0 Hz (when messages were recorded: their headers have no time)" in told and "nan" not in told


def test_one_frame_has_no_rate(tmp_path: Path) -> None:
    told = succeed("inspect", write_image_bag(tmp_path, "ros1", color, depth, count=1))
    assert "frames        1, 0.0 s (headers of" in told


@pytest.mark.parametrize("storage", STORAGES)
def test_sixteen_bits_in_a_plain_png_are_depth(tmp_path: Path, storage: str) -> None:
    def plain_png(messages: ImageMessages, time: float, i: int) -> Any:
        return messages.compressed_image(time, "png", as_png(depth_mm(i)))

    path = write_image_bag(tmp_path, storage, color, plain_png)
    assert largest_error_mm(path) == pytest.approx(0, abs=1e-3)
    colors = write_image_bag(tmp_path / "c", "ros1", lambda m, t, i: m.compressed_image(t, "png", as_png(picture(i))),
                             depth) if (tmp_path / "c").mkdir() is None else path  # fmt: skip
    assert np.array_equal(open_sequence(colors).frame(1).color, picture(1))


@pytest.mark.parametrize("storage", STORAGES)
def test_camera_info_begins_with_zeros(tmp_path: Path, storage: str) -> None:
    messages = ImageMessages(storage != "ros1")
    empty, right = messages.info("color_optical", (), "plumb_bob"), messages.info("color_optical", (), "plumb_bob")
    for name in ("k", "K", "p", "P"):
        if hasattr(empty, name):
            setattr(empty, name, np.zeros_like(getattr(empty, name)))
    info = f"{COLOR_TOPIC.rsplit('/', 1)[0]}/camera_info"
    sent = [(info, 999.9, empty), (info, 999.95, right)]
    for i in range(3):
        time = 1000 + i / 30
        sent += [(COLOR_TOPIC, time, color(messages, time, i)), ("/camera/depth", time, depth(messages, time, i))]
    path = tmp_path / ("walk" if messages.ros2 else "walk.bag")
    _write(path, storage, messages, sent)
    camera = open_sequence(path).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30, 31, 15, 11)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"step": 60}, "32x24.*16UC1.*64.*60"),
        ({"step": 80}, "80.*1920.*1536"),
        ({"width": 0}, "0x24.*16UC1"),
    ],
)
def test_sizes_that_do_not_fit(tmp_path: Path, change: dict[str, int], message: str) -> None:
    def wrong(messages: ImageMessages, time: float, i: int) -> Any:
        found = depth(messages, time, i)
        for name, value in change.items():
            setattr(found, name, value)
        return found

    with pytest.raises(SequenceError, match=message):
        open_sequence(write_image_bag(tmp_path, "ros1", color, wrong))


@pytest.mark.parametrize("storage", STORAGES)
def test_bags_without_messages(tmp_path: Path, storage: str) -> None:
    ros2 = storage != "ros1"
    path = tmp_path / ("walk" if ros2 else "walk.bag")
    _write(path, storage, ImageMessages(ros2), [])
    refuse(ggslam("inspect", path), "is a bag without any topic: nothing was recorded")


def test_a_damaged_frame_counts_once(tmp_path: Path) -> None:
    """Frames are looked at alone and in pairs."""
    folder = write_image_bag(tmp_path, "ros1", color, lambda m, t, i: wrong_step(m, t, i), count=14)
    report = inspect_sequence(open_sequence(folder, on_bad_frame="skip"), samples=14)
    assert len(report.damaged) == 1 and "1 of the sampled frames" in " ".join(report.warnings)


def wrong_step(messages: ImageMessages, time: float, i: int) -> Any:
    """The 13th image is damaged."""
    found = depth(messages, time, i)
    found.step = 60 if i == 12 else found.step
    return found
