# SPDX-License-Identifier: Apache-2.0
"""An error while a keyframe joins beside the next frames: its result is whole, and poses agree with the map."""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from joining_runs import CHEAP, DriftingCamera, there_and_back

from ggslam.errors import OpenCvError
from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.jobs.run.slam_loop import make_slam
from ggslam.loops.places import PlaceIndex
from ggslam.loops.pose_graph import PoseGraph
from ggslam.runs.recordings import SequenceRequest
from ggslam.scene.frame import Frame
from ggslam.slam.loop_closing import LoopCloser
from ggslam.slam.map_corrections import MapCorrections
from ggslam.slam.schedules import BesideTraining
from ggslam.slam.slam import Slam
from ggslam.tracking.surface import MeasuredSurface

FAILING = 12
"""Keyframe whose joining fails, if it is not the one that closes the loop."""


class InjectedError(Exception):
    """Not raised by anything else."""


def fail_in(
    monkeypatch: pytest.MonkeyPatch, kind: type, name: str, when: Callable[..., bool], error: type[Exception]
) -> None:
    """A method raises, once, before it does anything, as soon as its arguments fulfil something."""
    method, raised = getattr(kind, name), list[bool]()

    def fail(*arguments: object, **named: object) -> object:
        if not raised and when(*arguments):
            raised.append(True)
            raise error(name)
        return method(*arguments, **named)

    monkeypatch.setattr(kind, name, fail)


Stage = tuple[type, str, Callable[..., bool]]
STAGES: dict[str, Stage] = {
    "before its points join": (MapCorrections, "add_points", lambda c, *_: len(c._surface) == FAILING),
    "while its points join": (
        MeasuredSurface, "_gather", lambda s, placed, base, *_: len(s) == FAILING + 1 and len(placed) == 1,
    ),
    "after its points joined": (LoopCloser, "add", lambda loops, *_: len(loops) == FAILING),
    "while its place is described": (PlaceIndex, "describe", lambda places, *_: len(places) == FAILING),
    "within the optimisation": (PoseGraph, "optimise", lambda *_: True),
    "while the surface follows": (MeasuredSurface, "_gather", lambda s, *_: s.poses.version > 0),
    "after the correction was published": (MapCorrections, "_unite_objects", lambda *_: True),
}  # fmt: skip
MOVED = ("while the surface follows", "after the correction was published")


def play(slam: Slam, walk: list[Frame]) -> None:
    for frame in walk:
        slam.step(frame)
    slam.end_joining()


def distances(slam: Slam, camera: DriftingCamera) -> dict[str, float]:
    """How far apart what has to agree is, metres."""
    keyframes = slam.mapper.keyframes
    tracked = [np.linalg.norm(k.T_world_camera[:3, 3] - T[:3, 3])
               for k, T in zip(keyframes, slam.surface.poses, strict=True)]  # fmt: skip
    born, means = slam.map.birth_keyframe.numpy(), slam.map.means.detach().numpy()
    depths = []
    for keyframe in keyframes[-4:]:
        points = means[born == keyframe.index] @ keyframe.T_camera_world[:3, :3].T + keyframe.T_camera_world[:3, 3]
        camera_, z = keyframe.camera, points[:, 2]
        u = np.rint(camera_.fx * points[:, 0] / z + camera_.cx).astype(int).clip(0, camera_.width - 1)
        v = np.rint(camera_.fy * points[:, 1] / z + camera_.cy).astype(int).clip(0, camera_.height - 1)
        depths.append(np.median(np.abs(z - keyframe.depth_m()[v, u])) if len(z) else 0.0)
    pose = slam.pose_of(slam.frames[-1])
    return {
        "keyframes of map and surface": float(max(tracked)), "map and its keyframes": float(max(depths)),
        "tracker and frames": float(np.linalg.norm(pose[:3, 3] - camera.T[:3, 3])),
    }


@pytest.mark.parametrize("gap", [1, 2])
@pytest.mark.parametrize("stage", STAGES)
def test_poses_and_map_agree_after_an_error(
    room: Path, gap: int, stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    slam, camera, walk = there_and_back(room, gap)
    kind, name, when = STAGES[stage]
    fail_in(monkeypatch, kind, name, when, InjectedError)
    with pytest.raises(InjectedError, match=f"^{name}$"):
        play(slam, walk)
    result = slam.result()
    assert len(slam.corrections) == slam.moves_followed >= (stage in MOVED)
    assert slam.loops is not None
    slam.loops.check()
    count = len(slam.mapper.keyframes)
    assert len(slam.surface) == len(slam.loops) == len(result.keyframes) == count > 9
    assert not slam.end_notes  # it was raised
    for what, distance in distances(slam, camera).items():
        assert distance < 0.015, what  # the correction moves keyframes by 38 mm
    assert slam.corrections.pending_moves(slam.moves_followed) == (slam.surface.target, [])
    assert result.places is not None
    places = np.load(io.BytesIO(result.places))
    assert len(places["surface_counts"]) == len(places["loops_places_counts"]) == len(places["keyframe_poses"]) == count
    assert places["birth"].max() < count
    assert camera.before is not None
    assert len(result.frames) == camera.before.index + 1 and np.isfinite(result.trajectory()).all()


def test_the_first_error_is_raised_and_the_other_noted(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Training fails beside a joining that fails, too."""
    slam, camera, walk = there_and_back(room, gap=2)
    fail_in(monkeypatch, *STAGES["after its points joined"], InjectedError)
    fail_in(monkeypatch, Slam, "train", lambda slam, *_: len(slam.mapper.keyframes) == FAILING + 1, MemoryError)
    with pytest.raises(MemoryError):
        play(slam, walk)
    assert slam.joining.is_under_way
    result = slam.result()
    (note,) = [note for note in result.notes if "InjectedError" in note]
    assert note == "the newest keyframe was not taken over as a whole: InjectedError('add')"
    assert slam.result().notes.count(note) == 1
    assert len(slam.surface) == len(result.keyframes) == FAILING + 1
    assert max(distances(slam, camera).values()) < 0.015


def test_an_error_of_opencv_names_the_keyframe(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    slam, _, walk = there_and_back(room, gap=1)
    fail_in(monkeypatch, *STAGES["while its place is described"], cv2.error)
    with pytest.raises(OpenCvError) as raised:
        play(slam, walk)
    number = slam.mapper.keyframes[-1].frame_index
    assert str(raised.value).startswith(f"frame {number}: OpenCV: describe")
    assert slam.frames[-1].frame_index >= number


def test_a_run_goes_on_after_an_error_that_was_caught(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    slam, camera, walk = there_and_back(room, gap=2)
    fail_in(monkeypatch, *STAGES["before its points join"], InjectedError)
    errors = 0
    for frame in walk:
        try:
            slam.step(frame)
        except InjectedError:
            errors += 1
    result = slam.finish()
    assert errors == 1 and len(result.frames) >= len(walk) - 1
    assert len(slam.surface) == len(result.keyframes) > FAILING + 2 and len(slam.corrections)
    assert np.linalg.norm(camera.T[:3, 3]) < 0.06  # loops were closed: the walk ends where it began


@pytest.mark.parametrize("stage", ["before its points join", "while its place is described"])
def test_a_run_that_failed_is_written_and_another_starts_in_its_map(
    room: Path, tmp_path: Path, stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make(*arguments: Any) -> Slam:
        slam = make_slam(*arguments)
        slam.schedule = BesideTraining(nullcontext())
        return slam

    settings = [*CHEAP, "keyframes.max_gap=1"]
    with monkeypatch.context() as patch:
        patch.setattr("ggslam.jobs.run.slam_loop.make_slam", make)
        fail_in(patch, *STAGES[stage], InjectedError)
        outcome = execute(RunRequest(SequenceRequest(room), tmp_path / "a", overrides=settings, evaluate=False))
    assert isinstance(outcome.error, InjectedError) and outcome.failure is None
    assert not any("InjectedError" in note for note in outcome.result.notes)
    count = len(outcome.result.frames)
    assert np.isfinite(outcome.result.trajectory()).all() and FAILING <= count < 24
    again = SequenceRequest(room, stop=4)
    visit = RunRequest(
        again, tmp_path / "b", overrides=settings, evaluate=False, map=tmp_path / "a", localize_only=True
    )
    located = execute(visit)
    assert located.error is None
    np.testing.assert_allclose(located.result.trajectory()[:, :3, 3], outcome.result.trajectory()[:4, :3, 3], atol=0.03)
