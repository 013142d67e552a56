# SPDX-License-Identifier: Apache-2.0
"""A live camera through `execute`: its frames are mapped, kept and scored."""

from __future__ import annotations

import sys
import threading
import time
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from ggslam.errors import RunFolderError, SequenceError
from ggslam.formats.gaussian_ply import read_gaussian_ply
from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.jobs.serve.live_functions import LiveFunctions
from ggslam.jobs.serve.pausing import Pause
from ggslam.runs.recordings import LiveRequest, SequenceRequest, open_recording_of
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


def test_what_is_asked_is_done_while_no_frame_comes(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A camera that falls silent after four frames, until the map was saved."""
    beside, asked = tmp_path / "maps", threading.Event()
    functions = LiveFunctions(cast(Any, None), Pause(), beside)
    saved: list[dict[str, Any]] = []

    class SilentCamera:
        arrived = 0.0

        def __init__(self) -> None:
            self.sequence = open_sequence(room, stop=4)
            self.name, self.camera = "silent", self.sequence.camera

        def follow(self, going_on: Callable[[], bool], say: Callable[[str], None]) -> None:
            self.going_on = going_on

        def frames(self) -> Iterator[Frame]:
            yield from self.sequence.stream(masks=False)
            asked.set()
            while self.going_on() and not saved:
                time.sleep(0.01)

        def counts(self) -> dict[str, int]:
            return {}

        def reasons(self) -> dict[str, int]:
            return {}

        def close(self) -> None:
            pass

    def ask() -> None:
        asked.wait(60)
        saved.append(functions.save_map({"name": "now"}))

    monkeypatch.setitem(sys.modules, "silent_camera", types.SimpleNamespace(SilentCamera=SilentCamera))
    thread = threading.Thread(target=ask)
    thread.start()
    place = Path("python:silent_camera:SilentCamera")
    execute(RunRequest(LiveRequest(place), tmp_path / "run", overrides=FAST), waiting=functions.between_frames)
    thread.join(30)
    assert saved[0]["frames"] == 4 and len(read_gaussian_ply(beside / "now.ply")) == saved[0]["gaussians"] > 0


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


def test_latency(place: Path, room: Path, tmp_path: Path) -> None:
    """Of a camera since its frames came, for their stamps are of another clock; in real time since they were due."""
    live = execute(RunRequest(LiveRequest(place, stop=4), tmp_path / "live", overrides=FAST))
    latency = live.folder.timing().latency
    assert latency == live.latency and latency is not None and latency.since == "arrival" and latency.arrivals is None
    assert latency.pose is not None and latency.pose.count == 4 and 0 < latency.pose.median_s <= latency.pose.p95_s
    assert latency.map is not None and latency.map.count == len(live.result.keyframes)
    pace = [*FAST, "realtime_fps=8", "refine_iterations=1"]
    paced = execute(RunRequest(SequenceRequest(room, stop=6), tmp_path / "paced", overrides=pace, evaluate=False))
    latency = paced.folder.timing().latency
    assert latency is not None and latency.since == "due" and latency.pose is not None
    assert latency.pose.count == 5 - len(paced.result.dropped_frames)  # not the first one, which starts the clock
    assert 0 < latency.pose.median_s < 2 and "latency since the frame was due: pose" in latency.text()
    assert "Latency since the frame was due" in (paced.folder.path / "report.html").read_text()
    plain = execute(RunRequest(SequenceRequest(room, stop=2), tmp_path / "plain", overrides=FAST, evaluate=False))
    assert plain.latency is None and plain.folder.timing().latency is None


def test_options_for_recordings_only(place: Path) -> None:
    with pytest.raises(SequenceError, match="RoomCamera.*`stop`.*`scale`"):
        LiveRequest(place, stride=2).open()
