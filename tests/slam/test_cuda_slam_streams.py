# SPDX-License-Identifier: Apache-2.0
"""Frames are located on a stream beside the mapper's, and neither uses what the other is still at."""

from __future__ import annotations

from pathlib import Path

import pytest
from device_watch import DeviceWatch, UnorderedWork

from ggslam.mapping.cuda.mapper import CudaMapper
from ggslam.scene.frame import Frame
from ggslam.sequences import open_sequence
from ggslam.slam.color_poses import ColorPoses
from ggslam.slam.config import load_config
from ggslam.slam.realtime import RealtimeSlam
from ggslam.slam.slam import Slam

SETTINGS = ["device=cuda", "mapping.iterations_per_frame=1", "mapping.first_frame_iterations=2", "identity.every=1",
            "identity.pixels=64", "identity.neighbours.samples=10", "identity.neighbours.every=2",
            "identity.final_passes=1", "evaluation.held_out_every=0", "keyframes.max_gap=2"]  # fmt: skip


@pytest.fixture(scope="module")
def frames(room: Path) -> list[Frame]:
    return list(open_sequence(room, scale=0.25).stream(masks=True))[:4]


def start(frames: list[Frame]) -> Slam:
    return Slam(frames[0].camera, load_config(None, SETTINGS), has_masks=True)


def calls_by_stream(watch: DeviceWatch) -> dict[int, set[str]]:
    found: dict[int, set[str]] = {}
    for call in watch.calls:
        found.setdefault(call.stream, set()).add(call.operation)
    return found


@pytest.mark.long("the whole loop under emulation")
def test_tracking_does_not_wait_for_training(frames: list[Frame], monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor for a rendering of the map that frames are compared with, but for the map that this shows."""
    monkeypatch.setattr(ColorPoses, "_is_due", property(lambda self: True))
    with DeviceWatch(is_slow=True) as watch:
        slam = start(frames)
        for frame in frames:
            slam.step(frame)
        calls = calls_by_stream(watch)
        assert "train" in calls[0] and "project" in calls[0] and len(calls) == 2
        assert "track_wait" not in calls.pop(0) and "track_wait" in calls.popitem()[1]
        slam.finish()


@pytest.mark.long("the whole loop under emulation")
def test_who_reads_the_map_beside_training_would_be_found(
    frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CudaMapper, "note_valid", lambda mapper, frame: mapper.map.means.sum())
    with DeviceWatch(is_slow=True):
        slam = start(frames)
        with pytest.raises(UnorderedWork, match="sum .* and train .* use the same memory"):
            for frame in frames:
                slam.step(frame)


@pytest.mark.long("the whole loop under emulation")
def test_in_real_time_nothing_is_used_by_both(frames: list[Frame]) -> None:
    with DeviceWatch(is_slow=True) as watch:
        slam = start(frames)
        RealtimeSlam(slam, 0.5).run(frames, lambda frame, report: None)
        calls = calls_by_stream(watch)
        assert "train" in calls[0] and "track_wait" not in calls[0]
        slam.finish()
