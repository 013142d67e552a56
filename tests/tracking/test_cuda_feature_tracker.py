# SPDX-License-Identifier: Apache-2.0
"""The tracker of edges and planes on a device: the CPU's poses, and one call and one wait per frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from device_features import NO_LIMIT, apart, on_device
from device_watch import DeviceWatch
from feature_scenes import CAMERA, room_view

from ggslam.cuda.library import CudaLibrary
from ggslam.native.loader import NativeContext
from ggslam.scene.frame import Frame
from ggslam.scene.poses import se3_exp
from ggslam.tracking.cuda.points import CudaPoints
from ggslam.tracking.edges_planes.tracker import FeatureTracker
from ggslam.tracking.points import DeferredPoints
from ggslam.tracking.settings import TrackerSettings
from ggslam.tracking.surface import MeasuredSurface
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

STEP = np.array([0.02, -0.01, 0.008, 0.01, 0.015, 0.005])


def make(library: CudaLibrary | None) -> FeatureTracker:
    engine = None if library is None else on_device(library)
    return FeatureTracker(CAMERA, features=NO_LIMIT, context=NativeContext(1), engine=engine)


def view(i: int, corner: bool = True) -> Frame:
    return room_view(se3_exp(i * STEP), corner, sigma=0.002, seed=i)


def check_tracked(found: TrackingResult, expected: TrackingResult, most_m: float = 5e-5) -> None:
    assert found.status is expected.status
    assert found.reason.split(" ")[0] == expected.reason.split(" ")[0]
    shift, turn = apart(expected.T_world_camera, found.T_world_camera)
    assert shift < most_m and turn < most_m
    assert found.overlap == pytest.approx(expected.overlap, abs=0.01)
    assert found.median_depth_m == pytest.approx(expected.median_depth_m, rel=1e-3)
    assert (found.information is None) == (expected.information is None)
    if found.information is not None and expected.information is not None:
        most = 1e-2 * np.abs(expected.information).max()
        assert np.allclose(found.information, expected.information, atol=most)


def track_both(library: CudaLibrary, frames: list[Frame], most_m: float = 5e-5) -> list[TrackingResult]:
    trackers, results = (make(library), make(None)), []
    for frame in frames:
        found, expected = (tracker.track(frame) for tracker in trackers)
        check_tracked(found, expected, most_m)
        assert trackers[0].counts == trackers[1].counts
        results.append(found)
    return results


def test_a_motion_is_followed_as_on_the_cpu(cuda_library: CudaLibrary) -> None:
    results = track_both(cuda_library, [view(i) for i in range(8)])
    assert [result.status for result in results] == [TrackingStatus.FIRST] + 7 * [TrackingStatus.OK]
    for i, result in enumerate(results):
        shift, turn = apart(se3_exp(i * STEP), result.T_world_camera)
        assert shift < 2e-3 and turn < 1.5e-3


def test_frames_without_depth_and_elsewhere_are_lost_as_on_the_cpu(cuda_library: CudaLibrary) -> None:
    blank = replace(view(0), depth=np.zeros((240, 320), np.float32))
    wild = replace(view(1), depth=np.full((240, 320), np.nan, np.float32))
    elsewhere = room_view(se3_exp(np.array([-0.1, -0.1, 0.5, 0.0, -0.3, 0.0])))
    elsewhere = replace(elsewhere, color=np.zeros_like(elsewhere.color))
    results = track_both(cuda_library, [blank, view(0), blank, view(0), wild, view(1)])
    assert [result.status is TrackingStatus.LOST for result in results] == 3 * [True, False]
    results = track_both(cuda_library, [view(0), elsewhere, view(0)])
    assert [result.status is TrackingStatus.LOST for result in results] == [False, True, False]


def test_a_jump_is_recovered_as_on_the_cpu(cuda_library: CudaLibrary) -> None:
    jump = room_view(se3_exp(np.array([0.1, 0.05, -0.1, 0.0, -0.1, 0.9])), sigma=0.002, seed=9)
    results = track_both(cuda_library, [view(0), view(0), jump])
    assert results[-1].status is TrackingStatus.RECOVERED and "features of view" in results[-1].reason


def test_gicp_takes_over_on_the_device(cuda_library: CudaLibrary) -> None:
    """At a bare wall, where edges and planes leave directions open; its points are the device's."""
    found = []
    for library in (cuda_library, None):
        tracker = make(library)
        first = tracker.track(view(0, corner=False))
        surface = MeasuredSurface(TrackerSettings().target, tracker.context)
        surface.finish = library is None
        tracker.set_target(surface.add(first.points, first.T_world_camera))
        found.append([tracker.track(view(i, corner=False)) for i in (1, 2, 3)])
    for one, other in zip(*found, strict=True):
        assert one.gicp is not None and other.gicp is not None and isinstance(one.points, CudaPoints)
        check_tracked(one, other, 3e-4)


def test_a_corrected_world_and_a_new_start_are_followed(cuda_library: CudaLibrary) -> None:
    T_new_old, trackers = se3_exp(np.array([0.5, -0.2, 0.1, 0.05, 0.3, -0.1])), (make(cuda_library), make(None))
    for i in range(5):
        if i == 3:
            for tracker in trackers:
                tracker.move(T_new_old)
        check_tracked(*(tracker.track(view(i)) for tracker in trackers))
    for tracker in trackers:
        result = tracker.track(view(5))
        tracker.begin_part(tracker.state.motion.views[0], result.points, np.eye(4))
    found, expected = (tracker.track(view(6)) for tracker in trackers)
    check_tracked(found, expected)
    assert apart(se3_exp(6 * STEP), se3_exp(5 * STEP) @ found.T_world_camera)[0] < 5e-3


def test_a_recording_is_followed_as_on_the_cpu(cuda_library: CudaLibrary, frames: list[Frame]) -> None:
    trackers = []
    for library in (cuda_library, None):
        engine = None if library is None else on_device(library, camera=frames[0].camera)
        trackers.append(FeatureTracker(
            frames[0].camera, features=NO_LIMIT, context=NativeContext(1), T_world_camera=frames[0].T_world_camera,
            engine=engine,
        ))  # fmt: skip
    for frame in frames:
        found, expected = (tracker.track(frame) for tracker in trackers)
        check_tracked(found, expected, 1e-4)
        assert frame.T_world_camera is not None
        assert apart(frame.T_world_camera, found.T_world_camera)[0] < 0.02


def test_a_frame_is_one_call_and_one_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether or not it is added to the local map, whose turn is with the next frame; nothing is allocated."""
    with DeviceWatch() as watch:
        tracker = make(watch.library)
        made: list[object] = []
        for name in ("empty", "zeros", "full", "tensor", "empty_like"):
            usual = getattr(torch, name)
            monkeypatch.setattr(torch, name, lambda *a, usual=usual, **k: made.append(a) or usual(*a, **k))
        for i in range(8):
            frame = view(i)
            watch.forget()
            made.clear()
            result = tracker.track(frame)
            assert not [upload for upload in watch.uploads if upload.blocking]
            if i < 3:  # memory for three scans that take turns
                continue
            assert result.status is TrackingStatus.OK
            assert [call.operation for call in watch.calls] == ["feature_track_wait"]
            assert [wait.operation for wait in watch.waits] == ["ggslam_cuda_feature_track_wait"]
            assert len(watch.uploads) == 1 and watch.uploads[0].bytes == 4 * 320 * 240 and not watch.downloads
            assert made == []
            waited = len(watch.calls)
            assert result.median_depth_m > 0 and tracker.counts.planes > 500 and len(watch.calls) == waited


def test_points_of_a_keyframe_ask_nothing_of_the_device() -> None:
    """Another thread may read them while the next frame is tracked."""
    with DeviceWatch() as watch:
        trackers = make(watch.library), make(None)
        for i in range(2):
            found, expected = (tracker.track(view(i)) for tracker in trackers)
        watch.forget()
        assert isinstance(found.points, DeferredPoints)
        found.points.send()
        one, other = found.points.read(), expected.points.read()
        assert one.points.tobytes() == other.points.tobytes() and len(one) > 1000
        assert not watch.calls and not watch.uploads and not watch.waits
