# SPDX-License-Identifier: Apache-2.0
"""What is sent to rerun: calls against a stand-in, a file with the real one where it is installed."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ggslam.errors import ConfigError, MissingDependency
from ggslam.jobs.watch.rerun_follower import LiveLog, RerunTuning
from ggslam.movers.mover_table import MoverSight
from ggslam.reporting.rerun_log import RerunLog
from ggslam.scene.camera import Camera
from ggslam.slam.result import StepReport, TrackedFrame

CAMERA = Camera(8, 6, 5.0, 5.0, 3.5, 2.5)


class Archetype(SimpleNamespace):
    """Remembers what it was made of."""

    def __init__(self, kind: str, *values: Any, **named: Any) -> None:
        super().__init__(kind=kind, values=values, **named)


class Stream:
    """Remembers what was logged: (entity, archetype, frame)."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.logged: list[tuple[str, Any, int | None]] = []
        self.times: dict[str, Any] = {}
        self.saved_to: str | None = None
        self.closed = False

    def save(self, path: str) -> None:
        self.saved_to = path

    def send_recording_name(self, name: str) -> None:
        self.name = name

    def set_time(self, timeline: str, sequence: int | None = None, duration: float | None = None) -> None:
        self.times[timeline] = duration if sequence is None else sequence

    def log(self, entity: str, archetype: Any, static: bool = False) -> None:
        self.logged.append((entity, archetype, None if static else self.times["frame"]))

    def flush(self) -> None:
        pass

    def disconnect(self) -> None:
        self.closed = True

    def entities(self, name: str) -> list[Any]:
        return [archetype for entity, archetype, _ in self.logged if entity == name]


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    module: Any = ModuleType("rerun")
    module.RecordingStream = Stream
    module.ViewCoordinates = SimpleNamespace(RIGHT_HAND_Y_DOWN="y down")
    for kind in ("Pinhole", "Transform3D", "EncodedImage", "DepthImage", "Points3D", "LineStrips3D", "Scalars",
                 "Boxes3D", "Quaternion", "Clear"):  # fmt: skip
        setattr(module, kind, lambda *values, _kind=kind, **named: Archetype(_kind, *values, **named))
    monkeypatch.setitem(sys.modules, "rerun", module)


def follow(log: RerunLog, frames: int) -> LiveLog:
    """A run of `frames` frames, every second one a keyframe, the third one lost; the camera moves along x."""
    live = LiveLog(log)
    gaussians = SimpleNamespace(count=2, means=_tensor(2, 3), rgb=_tensor(2, 3), scales=_tensor(2, 3))
    sights = [MoverSight(k, _moved(1.0), np.full(3, -0.5), np.array([0.5, 0.5, 1.5]), 0.1) for k in (4, 5)]
    track = SimpleNamespace(number=7, sights=[])
    movers = SimpleNamespace(tracks=SimpleNamespace(tracks=[track]))
    slam: Any = SimpleNamespace(movers=movers, camera=CAMERA, map=gaussians, pose_of=lambda f: _moved(f.frame_index))
    for k in range(frames):
        track.sights = [sight for sight in sights if sight.frame <= k]
        status = "lost" if k == 3 else "ok"
        tracked = TrackedFrame(k, k, 100 + k / 10, 0, np.eye(4), 0.9, 0.01, status)
        frame: Any = SimpleNamespace(
            index=k, timestamp=100 + k / 10, color=np.full((6, 8, 3), 99, np.uint8), depth=np.ones((6, 8), np.float32)
        )
        loss = float("nan") if k == 1 else 0.5
        live(slam, frame, StepReport(tracked, k % 2 == 0, 2, 30.0, 0.1, loss))
    return live


def _moved(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def _tensor(*shape: int) -> Any:
    import torch

    return torch.ones(shape)


@pytest.mark.usefixtures("stand_in")
def test_poses_images_map_and_numbers_are_sent() -> None:
    log = RerunLog("run.rrd", "kitchen")
    stream: Stream = log._stream
    live = follow(log, 4 * RerunTuning.keyframes_per_map)
    assert stream.saved_to == "run.rrd" and stream.name == "kitchen"
    assert stream.entities("world/camera")[0].image_from_camera == [[5, 0, 3.5], [0, 5, 2.5], [0, 0, 1]]
    poses = [a.translation[0] for a in stream.entities("world/camera")[1:]]
    assert poses == [k for k in range(20) if k != 3]  # the lost frame has none
    images = stream.entities("world/camera/image")
    assert len(images) == 20 and images[0].contents[:2] == b"\xff\xd8"
    assert [f for e, _, f in stream.logged if e == "world/map"] == [0, 2 * RerunTuning.keyframes_per_map]
    assert (stream.entities("world/camera/depth")[0].values[0] == 1000).all()
    assert len(stream.entities("plots/loss")) == 19 and len(stream.entities("plots/overlap")) == 20
    assert stream.times == {"frame": 19, "time": pytest.approx(1.9)}
    boxes = [(a, f) for e, a, f in stream.logged if e == "world/movers/7"]
    assert [(a.kind, f) for a, f in boxes] == [("Boxes3D", 4), ("Boxes3D", 5), ("Clear", 6)]
    np.testing.assert_allclose(boxes[1][0].centers, [[6, 0, 0.5]])  # camera at 5, mover 1 from it, its middle ahead
    np.testing.assert_allclose(boxes[1][0].half_sizes, [[0.5, 0.5, 1]])
    refined: Any = SimpleNamespace(
        trajectory=lambda: np.stack([_moved(1), np.full((4, 4), np.nan), _moved(2)]), gaussians=[]
    )
    live.finish(refined)
    live.close()
    assert stream.closed
    np.testing.assert_array_equal(stream.entities("world/path")[-1].values[0][0], [[1, 0, 0], [2, 0, 0], [2, 0, 0]])


@pytest.mark.usefixtures("stand_in")
@pytest.mark.parametrize("target", ["run.txt", "viewer", "no_such_folder/run.rrd"])
def test_targets_that_are_none_are_refused(target: str) -> None:
    with pytest.raises(ConfigError, match="`log`"):
        RerunLog(target, "kitchen")


def test_without_rerun_one_message_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingDependency, match=r"ggslam\[rerun\]"):
        RerunLog("rerun", "kitchen")


def test_a_folder_called_rerun_is_not_taken_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "rerun").mkdir()
    monkeypatch.setitem(sys.modules, "rerun", None)
    del sys.modules["rerun"]  # imported anew, and what is imported here does not stay
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    with pytest.raises(MissingDependency):
        RerunLog("rerun", "kitchen")


def test_the_real_one_writes_a_file(tmp_path: Path) -> None:
    pytest.importorskip("rerun").RecordingStream  # noqa: B018
    path = tmp_path / "run.rrd"
    follow(RerunLog(str(path), "kitchen"), 6).close()
    data = path.read_bytes()
    assert data[:4] == b"RRF2" and b"world/camera/image" in data
