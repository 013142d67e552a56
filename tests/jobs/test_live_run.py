# SPDX-License-Identifier: Apache-2.0
"""A live camera through `execute`: its frames are mapped, kept and scored."""

from __future__ import annotations

import sys
import types
from collections.abc import Iterator
from pathlib import Path

import pytest

from ggslam.errors import RunFolderError, SequenceError
from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.runs.recordings import LiveRequest, open_recording_of
from ggslam.scene.frame import Frame
from ggslam.sequences import open_sequence


@pytest.fixture
def place(room: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A camera that shows the first frames of the room."""

    class RoomCamera:
        def __init__(self) -> None:
            self.sequence = open_sequence(room, stop=8)
            self.name, self.camera = "room-camera", self.sequence.camera

        def frames(self) -> Iterator[Frame]:
            return self.sequence.stream(masks=False)

        def close(self) -> None:
            pass

    monkeypatch.setitem(sys.modules, "room_camera", types.SimpleNamespace(RoomCamera=RoomCamera))
    return Path("python:room_camera:RoomCamera")


FAST = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=1"]


def test_frames_are_kept_and_scored(place: Path, tmp_path: Path) -> None:
    request = LiveRequest(place, stop=6, record=tmp_path / "kept")
    outcome = execute(RunRequest(request, out=tmp_path / "run", overrides=FAST))
    assert outcome.error is None and len(outcome.result.frames) == 6
    assert outcome.metrics is not None and outcome.metrics.images.all.frames == 6
    again = open_recording_of(outcome.folder)
    assert again.path == tmp_path / "kept" and len(again) == 6


def test_frames_that_are_not_kept(place: Path, tmp_path: Path) -> None:
    outcome = execute(RunRequest(LiveRequest(place, stop=3), out=tmp_path / "run", overrides=FAST))
    assert outcome.error is None and outcome.metrics is None and len(outcome.result.frames) == 3
    with pytest.raises(RunFolderError, match=r"python:room_camera:RoomCamera.*`record`"):
        open_recording_of(outcome.folder)


def test_options_for_recordings_only(place: Path) -> None:
    with pytest.raises(SequenceError, match="RoomCamera.*`stop`.*`scale`"):
        LiveRequest(place, stride=2).open()
