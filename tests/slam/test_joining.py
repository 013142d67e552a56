# SPDX-License-Identifier: Apache-2.0
"""Where frames do not wait for a keyframe, it joins what they are aligned to beside the next one; when they see it is
decided by their number. The schedule of a GPU, with the map on the CPU."""

from __future__ import annotations

import dataclasses
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from joining_runs import start, there_and_back

from ggslam.scene.frame import Frame
from ggslam.scene.poses import se3_exp
from ggslam.sequences import open_sequence
from ggslam.slam.joining import Joining
from ggslam.slam.loop_closing import LoopCloser
from ggslam.slam.map_corrections import MapCorrections
from ggslam.slam.relocalization import Relocalizer
from ggslam.tracking.gicp import GicpTarget
from ggslam.tracking.tracker import TrackingResult, TrackingStatus


@pytest.fixture(scope="module")
def frames(room: Path) -> list[Frame]:
    return list(open_sequence(room, scale=0.5).stream())


class TestJoining:
    def test_the_number_of_steps_decides(self) -> None:
        joining, done, may_end = Joining[str](), list[str](), threading.Event()

        def work() -> str:
            may_end.wait()
            return "found"

        joining.begin_step()
        joining.start(work, done.append, done.clear)
        joining.begin_step()
        assert joining.is_under_way and not done
        threading.Timer(0.05, may_end.set).start()
        joining.begin_step()
        assert done == ["found"] and not joining.is_under_way
        joining.start(lambda: "at once", done.append, done.clear)
        time.sleep(0.05)
        joining.begin_step()
        assert done == ["found"]
        joining.end()
        joining.end()
        joining.begin_step()
        assert done == ["found", "at once"]

    def test_errors_are_raised_where_it_is_taken_over(self) -> None:
        joining, done, given_up = Joining[float](), list[float](), list[bool]()
        joining.start(lambda: 1 / 0, done.append, lambda: given_up.append(True))
        joining.begin_step()
        with pytest.raises(ZeroDivisionError):
            joining.begin_step()
        assert not joining.is_under_way and not done and given_up == [True]
        joining.end()
        assert given_up == [True]

    def test_interrupted_waiting_leaves_it_under_way(self, monkeypatch: pytest.MonkeyPatch) -> None:
        joining, done, given_up = Joining[str](), list[str](), list[bool]()
        joining.start(lambda: "found", done.append, lambda: given_up.append(True))
        queue = joining._thread._done

        class Interrupted:
            def get(self) -> None:
                joining._thread._done = queue  # once
                raise KeyboardInterrupt

        joining._thread._done = Interrupted()  # type: ignore[assignment]
        with pytest.raises(KeyboardInterrupt):
            joining.end()
        assert joining.is_under_way and not done and not given_up
        joining.end()
        assert done == ["found"] and not joining.is_under_way and not given_up


def test_the_next_frame_is_aligned_to_what_there_was_before(frames: list[Frame]) -> None:
    slam = start(frames, "keyframes.max_gap=3", "keyframes.min_overlap=0.01")
    seen, keyframes, track = list[GicpTarget | None](), list[bool](), slam.tracker.track

    def noted(frame: Frame) -> TrackingResult:
        seen.append(slam.tracker.target)
        return dataclasses.replace(track(frame), overlap=0.9)

    slam.tracker.track = noted  # type: ignore[method-assign]
    for frame in frames[:8]:
        keyframes.append(slam.step(frame).is_keyframe)
    assert keyframes == [True, False, False] * 2 + [True, False]
    assert seen[0] is None and seen[1] is not None  # nothing was there before the first
    assert seen[1] is seen[2] is seen[3] is seen[4]
    assert seen[5] is not seen[4] and seen[5] is seen[6] is seen[7]
    slam.step(frames[8])
    assert seen[8] is not seen[7] and seen[8] is slam.surface.target


@pytest.mark.parametrize("gap", [1, 2])
def test_runs_repeat_bit_for_bit_however_long_it_takes(
    frames: list[Frame], gap: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the map shows every keyframe, the last one, too."""
    found = []
    for pause in (0.0, 0.15):
        add, add_points = LoopCloser.add, MapCorrections.add_points

        def slow(*arguments: object, pause: float = pause, add: object = add) -> object:
            time.sleep(pause)
            return add(*arguments)  # type: ignore[operator]

        def slow_points(*arguments: object, pause: float = pause, add: object = add_points) -> None:
            time.sleep(pause)
            add(*arguments)  # type: ignore[operator]

        with monkeypatch.context() as patch:
            patch.setattr(LoopCloser, "add", slow)
            patch.setattr(MapCorrections, "add_points", slow_points)
            slam = start(frames, f"keyframes.max_gap={gap}")
            for frame in frames[:7]:
                slam.step(frame)
            result = slam.finish()
        assert slam.loops is not None
        assert len(slam.surface) == len(slam.loops) == len(result.keyframes) >= 7 // gap
        found.append((result.trajectory(), result.gaussians.means.numpy().tobytes()))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    assert found[0][1] == found[1][1]


def test_a_lost_frame_goes_along_with_a_loop_that_is_closed_before_it_is_looked_for(
    frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    slam = start(frames, "keyframes.max_gap=1", "keyframes.min_overlap=0.01")
    track, apply, lost = slam.tracker.track, slam.corrections.apply, list[np.ndarray]()
    T_new_old, status = se3_exp(np.array([0.1, 0, 0, 0, 0.05, 0])), TrackingStatus.OK

    def find(relocalizer: Relocalizer, frame: Frame, tracking: TrackingResult) -> None:
        lost.append(tracking.T_world_camera)

    def close(correction: object, loops: LoopCloser) -> None:
        slam.corrections.moves.append(T_new_old)

    slam.tracker.track = lambda frame: dataclasses.replace(  # type: ignore[method-assign]
        track(frame), overlap=0.9, status=status
    )
    for frame in frames[:2]:
        slam.step(frame)
    slam.end_joining()
    with monkeypatch.context() as patch:
        patch.setattr(LoopCloser, "add", lambda *_: "a correction")
        patch.setattr(slam.corrections, "apply", close)
        patch.setattr(Relocalizer, "find", find)
        slam.step(frames[2])
        assert slam.joining.is_under_way and not len(slam.corrections)
        status, before = TrackingStatus.LOST, slam.tracker.state.motion.T_world_camera.copy()
        moved: list[np.ndarray] = []
        patch.setattr(slam.filters, "move", moved.append)
        slam.step(frames[3])
    assert slam.moves_followed == len(slam.corrections) == 1 and len(moved) == 1
    assert len(lost) == 1 and not np.allclose(lost[0], before)
    np.testing.assert_allclose(apply.__self__.moves[0], T_new_old)


def test_a_run_that_is_closed_takes_nothing_over(frames: list[Frame], monkeypatch: pytest.MonkeyPatch) -> None:
    slam = start(frames, "keyframes.max_gap=1", "keyframes.min_overlap=0.01")
    track = slam.tracker.track
    slam.tracker.track = lambda frame: dataclasses.replace(track(frame), overlap=0.9)  # type: ignore[method-assign]
    slam.step(frames[0])
    monkeypatch.setattr(LoopCloser, "add", lambda *_: 1 / 0)
    slam.step(frames[1])
    assert slam.joining.is_under_way
    slam.close()
    assert not slam.joining.is_under_way


def test_where_the_target_shows_little_the_next_frame_waits(frames: list[Frame]) -> None:
    slam = start(frames, "keyframes.max_gap=1")
    track, overlap = slam.tracker.track, 0.74
    slam.tracker.track = lambda frame: dataclasses.replace(track(frame), overlap=overlap)  # type: ignore[method-assign]
    for frame in frames[:3]:
        slam.step(frame)
        assert not slam.joining.is_under_way and len(slam.surface) == len(slam.mapper.keyframes)
    overlap = 0.76
    slam.step(frames[3])
    assert slam.joining.is_under_way


def test_a_lost_camera_is_looked_for_at_all_keyframes(frames: list[Frame], monkeypatch: pytest.MonkeyPatch) -> None:
    slam = start(frames, "keyframes.max_gap=1", "keyframes.min_overlap=0.01")
    known, track, status = list[int](), slam.tracker.track, TrackingStatus.OK

    def find(relocalizer: Relocalizer, *_: object) -> None:
        known.append(len(relocalizer.loops))

    monkeypatch.setattr(Relocalizer, "find", find)
    slam.tracker.track = lambda frame: dataclasses.replace(  # type: ignore[method-assign]
        track(frame), overlap=0.9, status=status
    )
    for frame in frames[:3]:
        slam.step(frame)
    assert slam.joining.is_under_way and not known
    status = TrackingStatus.LOST
    slam.step(frames[3])
    assert known == [3] and not slam.joining.is_under_way


@pytest.mark.parametrize("gap", [1, 2])
def test_a_loop_that_is_found_beside_frames_moves_them_all(room: Path, gap: int) -> None:
    slam, camera, walk = there_and_back(room, gap)
    for frame in walk:
        slam.step(frame)
    slam.end_joining()
    slam.follow_corrections()
    assert len(slam.corrections) and "closed" in {event.kind for event in slam.parts.events()}
    assert slam.moves_followed == len(slam.corrections)
    error = np.linalg.norm(camera.T[:3, 3])  # the walk ends where it began
    assert error < 0.06, error
    pose = slam.pose_of(slam.frames[-1])
    np.testing.assert_allclose(pose[:3, 3], camera.T[:3, 3], atol=0.01)
