# SPDX-License-Identifier: Apache-2.0
"""A recorded bag, played into topics, gives the run of the bag."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags")
sys.path.insert(0, str(Path(__file__).parent.parent / "middleware"))
from local_node import LocalNetwork
from rosbags import rosbag2

from ggslam.errors import ConfigError, MiddlewareError
from ggslam.jobs.play.camera_topics import TopicForm
from ggslam.jobs.play.play import Played, PlayRequest, play
from ggslam.jobs.progress import SilentObserver
from ggslam.jobs.run.pipeline import RunOutcome, RunRequest, execute
from ggslam.messages.contents import Lens, Picture
from ggslam.messages.ros2_images import CAMERA_INFO, IMAGE, camera_info_message, image_message
from ggslam.middleware.node import SENSOR_DATA
from ggslam.middleware.types import message_types
from ggslam.runs.recordings import LiveRequest, SequenceRequest, open_recording_of
from ggslam.scene.frame import Frame
from ggslam.sequences import open_sequence
from ggslam.sequences.formats import ros2_topics
from ggslam.sequences.formats.ros2_inbox import stamp_of
from ggslam.sequences.formats.ros2_topics import Ros2Camera

FAST = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=1", "refine_iterations=4"]
PLACE = Path("ros2://camera/color,camera/depth?idle=1&wait=20")


@pytest.fixture(scope="module", params=[False, True], ids=["16UC1", "32FC1"])
def bag(request: pytest.FixtureRequest, room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first frames of the room as a bag."""
    path = tmp_path_factory.mktemp("played") / "walk"
    types = message_types()
    kinds = {"color": IMAGE, "depth": IMAGE, "camera_info": CAMERA_INFO}
    with rosbag2.Writer(path, version=9) as writer:
        ends = {
            name: writer.add_connection(f"/camera/{name}", kind, typestore=types._store) for name, kind in kinds.items()
        }
        for frame in open_sequence(room, stop=8).stream(masks=False):
            at = 1000 + frame.index / 30
            messages = {
                "camera_info": camera_info_message(types, Lens("optical", frame.camera), at),
                "color": image_message(types, Picture("optical", frame.color), at),
                "depth": image_message(types, Picture("optical", frame.depth), at, request.param),
            }
            for name, message in messages.items():
                writer.write(ends[name], round(at * 1e9), types.encode(kinds[name], message))
    return path


class Stage:
    """A network in memory with a player in a thread, which waits with each frame until the run has done the last one.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.network = LocalNetwork()
        self.gate = threading.Semaphore(1)
        monkeypatch.setattr(ros2_topics, "open_node", lambda request, name: self.network.node(name))
        frames = Ros2Camera.frames

        def one_by_one(camera: Ros2Camera) -> Iterator[Frame]:
            for frame in frames(camera):
                yield frame
                self.gate.release()

        monkeypatch.setattr(Ros2Camera, "frames", one_by_one)
        self.played: list[Played] = []

    def start(self, request: PlayRequest) -> threading.Thread:
        node = self.network.node("play")
        make = node.publisher

        def publisher(topic: str, kind: str, qos: Any) -> Any:
            made = make(topic, kind, qos)
            if topic.endswith("camera_info"):
                send = made.send
                made.send = lambda content: (self.gate.acquire(timeout=10), send(content))
            return made

        node.publisher = publisher  # type: ignore[method-assign]
        player = threading.Thread(
            target=lambda: self.played.append(play(request, SilentObserver(), node)), daemon=True
        )
        player.start()
        return player


def played_as_stored(bag: Path) -> PlayRequest:
    form = TopicForm(metres=open_sequence(bag).depth_scale == 1)
    return PlayRequest(SequenceRequest(bag), form=form, rate=1000, recorded_stamps=True)


def path_of(outcome: RunOutcome) -> str:
    assert outcome.error is None
    return (outcome.folder.path / "trajectory.txt").read_text()


def test_run_of_a_bag_that_is_played(bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    of_bag = execute(RunRequest(SequenceRequest(bag), tmp_path / "bag", overrides=FAST, evaluate=False))
    stage = Stage(monkeypatch)
    player = stage.start(played_as_stored(bag))
    kept = tmp_path / "kept"
    live = execute(RunRequest(LiveRequest(PLACE, record=kept), tmp_path / "live", overrides=FAST, evaluate=False))
    player.join(10)
    assert stage.played[0].frames == 8 and stage.played[0].left_out == 0
    assert path_of(live) == path_of(of_bag) and len(path_of(live).splitlines()) >= 8
    timing = live.folder.timing().latency
    assert timing is not None and timing.since == "arrival" and timing.pose is not None and timing.pose.count == 8
    assert timing.arrivals is not None and timing.arrivals.pairs == timing.arrivals.taken == 8
    assert timing.arrivals.lost == timing.arrivals.overwritten == timing.arrivals.unmatched == 0
    report = (live.folder.path / "report.html").read_text()
    assert "Latency since the picture came" in report and "pairs overwritten by newer ones" in report
    again = open_recording_of(live.folder)
    assert len(again) == 8 and again.path == kept


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_frames_of_a_bag_that_is_played(bag: Path, monkeypatch: pytest.MonkeyPatch, scale: float) -> None:
    stage, wanted = Stage(monkeypatch), open_sequence(bag, scale=scale)
    player = stage.start(played_as_stored(bag))
    camera = Ros2Camera(str(PLACE), scale)
    assert camera.camera == wanted.camera
    frames = list(camera.frames())
    player.join(10)
    assert len(frames) == len(wanted)
    for found, frame in zip(frames, wanted.stream(), strict=True):
        np.testing.assert_array_equal(found.color, frame.color)
        np.testing.assert_array_equal(found.depth, frame.depth)
        assert (found.index, found.timestamp, found.depth_delay) == (frame.index, frame.timestamp, frame.depth_delay)


def test_what_was_sent(room: Path) -> None:
    network = LocalNetwork()
    reading = SequenceRequest(room, stop=4)
    with pytest.raises(MiddlewareError, match=r"nobody listens to `/eye/color` and `/eye/depth` within 0.2 s"):
        play(PlayRequest(reading, form=TopicForm("eye"), wait_s=0.2), SilentObserver(), network.node("play"))
    notes: list[str] = []

    class Observer(SilentObserver):
        def note(self, text: str) -> None:
            notes.append(text)

    played = play(PlayRequest(reading, form=TopicForm("eye"), fps=50, wait_s=None), Observer(), network.node("play"))
    assert played.frames == 4 and played.bytes > 4 * 160 * 120 * 5 and played.text().startswith("sent 4 frames in ")
    assert any("whole millimetres" in note for note in notes) and "/eye/color, /eye/depth, /eye/camera_info" in notes[0]


def test_loop_and_wall_clock(room: Path) -> None:
    """Rounds go on in time; stamps are those of sending."""
    network, got = LocalNetwork(), list[bytes]()
    listener = network.node("listener")
    listener.subscribe("/camera/color", IMAGE, SENSOR_DATA, lambda received: got.append(received.content))
    reading = SequenceRequest(room, stop=2)

    class Enough(SilentObserver):
        def advance(self, done: int, total: int) -> None:
            if len(got) >= 5:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        play(PlayRequest(reading, fps=50, loop=True, wait_s=None), Enough(), network.node("play"))
    times = [stamp_of(content) for content in got]
    assert np.diff(times).min() > 0 and abs(times[0] - time.time()) < 60


def test_rigs_are_refused(rig: Path) -> None:
    with pytest.raises(ConfigError, match="a rig cannot be played"):
        play(PlayRequest(SequenceRequest(rig)), SilentObserver(), LocalNetwork().node("play"))
