# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from feature_odometry import FeatureOdometry, LidarFeatures, split_features
from feature_scenes import CAMERA, room_view
from worlds.pose_graph import read_pose_graph

from ggslam.features.orb import FeatureView
from ggslam.formats.point_cloud import read_point_cloud
from ggslam.formats.raw_points import read_raw_points
from ggslam.native.loader import NativeContext
from ggslam.scene.poses import inverse, se3_exp, se3_log
from ggslam.sequences.factory import open_sequence
from ggslam.tracking.edges_planes.settings import LIDAR, FeatureAlignSettings, FeatureTrackerSettings
from ggslam.tracking.edges_planes.tracker import FeatureTracker
from ggslam.tracking.gicp import align
from ggslam.tracking.points import DeferredPoints, extract_points
from ggslam.tracking.settings import DepthNoise, PointSettings, TrackerSettings
from ggslam.tracking.surface import MeasuredSurface
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

NO_LIMIT = FeatureTrackerSettings(align=FeatureAlignSettings(budget_ms=0))


def make_tracker(features: FeatureTrackerSettings = NO_LIMIT) -> FeatureTracker:
    return FeatureTracker(CAMERA, features=features, context=NativeContext(2))


def run(tracker: FeatureTracker, poses: list[np.ndarray], corner: bool = True) -> list[TrackingResult]:
    return [tracker.track(room_view(T, corner, sigma=0.002, seed=i)) for i, T in enumerate(poses)]


def with_target(tracker: FeatureTracker, result: TrackingResult) -> None:
    """A keyframe for G-ICP."""
    surface = MeasuredSurface(TrackerSettings().target, tracker.context)
    tracker.set_target(surface.add(result.points, result.T_world_camera))


def error_m(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(se3_log(inverse(truth) @ found)[:3]))


def test_a_motion_is_followed_without_any_target() -> None:
    poses = [se3_exp(i * np.array([0.02, -0.01, 0.008, 0.01, 0.015, 0.005])) for i in range(10)]
    results = run(make_tracker(), poses)
    assert results[0].status is TrackingStatus.FIRST
    for result, truth in zip(results[1:], poses[1:], strict=True):
        assert result.status is TrackingStatus.OK
        assert error_m(result.T_world_camera, truth) < 3e-3
        assert result.overlap > 0.8 and 0 < result.rmse_m < 0.005


def test_the_result_has_what_a_pose_graph_and_a_keyframe_need() -> None:
    tracker = make_tracker()
    result = run(tracker, [np.eye(4), se3_exp(np.array([0.1, 0, 0, 0, 0, 0]) * 0.2)])[-1]
    assert isinstance(result.points, DeferredPoints)
    assert result.median_depth_m == pytest.approx(1.5, abs=0.5)
    assert result.points._points is None  # nobody has read them, so nothing was extracted
    frame = room_view(se3_exp(np.array([0.1, 0, 0, 0, 0, 0]) * 0.2), sigma=0.002, seed=1)
    expected = extract_points(frame.depth, CAMERA, PointSettings(), tracker.noise or DepthNoise(), tracker.context)
    assert len(result.points) == len(expected)
    assert np.array_equal(result.points.read().normals, expected.normals)
    assert result.gicp is None and result.information is not None
    information, c = result.information, result.T_world_camera[:3, 3]
    assert np.linalg.eigvalsh(information)[0] > 0
    # A turn about the camera's centre, which is, about the world's origin, the same turn and a shift, is known better
    # than one about the origin 10 m away: it moves what is seen less.
    w = np.array([0.1, -0.2, 0.3])
    about_camera, far = np.concatenate([-np.cross(w, c), w]), np.concatenate([-np.cross(w, c + [10, 0, 0]), w])
    assert 0 < about_camera @ information @ about_camera < 0.1 * (far @ information @ far)


def test_a_bare_wall_is_degenerate_and_grey_values_hold_the_camera() -> None:
    poses = [se3_exp(i * np.array([0.012, 0.006, 0, 0, 0, 0.01])) for i in range(5)]
    alone = run(make_tracker(), poses, corner=False)[-1]
    assert alone.status is TrackingStatus.DEGENERATE
    tracker = make_tracker()
    with_target(tracker, run(tracker, poses[:1], corner=False)[0])
    held = run(tracker, poses[1:], corner=False)[-1]
    assert error_m(held.T_world_camera, poses[-1]) < 4e-3 < error_m(alone.T_world_camera, poses[-1])


def test_without_depth_a_frame_is_lost_and_tracking_goes_on_after_it() -> None:
    tracker, still = make_tracker(), np.eye(4)
    blank = replace(room_view(still), depth=np.zeros((240, 320), np.float32))
    assert tracker.track(blank).status is TrackingStatus.LOST
    assert run(tracker, [still])[0].status is TrackingStatus.FIRST
    lost = tracker.track(blank)
    assert lost.status is TrackingStatus.LOST and "too few of 0 planes" in lost.reason
    back = run(tracker, [still])[0]
    assert back.status is TrackingStatus.OK and error_m(back.T_world_camera, still) < 2e-3


def test_another_place_is_lost() -> None:
    tracker = make_tracker()
    run(tracker, [np.eye(4)])
    elsewhere = room_view(se3_exp(np.array([-0.1, -0.1, 0.5, 0.0, -0.3, 0.0])))
    lost = tracker.track(replace(elsewhere, color=np.zeros_like(elsewhere.color)))
    assert lost.status is TrackingStatus.LOST and "the local map" in lost.reason
    assert np.array_equal(lost.T_world_camera, np.eye(4))


def test_a_jump_is_recovered_by_image_features() -> None:
    jump, tracker = se3_exp(np.array([0.1, 0.05, -0.1, 0.0, -0.1, 0.9])), make_tracker()
    result = run(tracker, [np.eye(4), np.eye(4), jump])[-1]
    assert result.status is TrackingStatus.RECOVERED and "features of view" in result.reason
    assert error_m(result.T_world_camera, jump) < 5e-3


def test_gicp_takes_over_where_the_local_map_fails() -> None:
    tracker = make_tracker()
    first = run(tracker, [np.eye(4)])[0]
    with_target(tracker, first)
    tracker.local_map.clear()
    far = se3_exp(np.array([5.0, 0, 0, 0, 0, 0]))
    tracker.local_map.add(tracker._extractor.extract(room_view(np.eye(4)).depth, DepthNoise()), far)
    result = run(tracker, [se3_exp(np.array([0.01, 0, 0, 0, 0, 0]))])[0]
    assert result.status is TrackingStatus.RECOVERED and result.reason.startswith("G-ICP")
    assert error_m(result.T_world_camera, se3_exp(np.array([0.01, 0, 0, 0, 0, 0]))) < 3e-3
    alone = make_tracker(replace(NO_LIMIT, gicp_fallback=False))
    with_target(alone, run(alone, [np.eye(4)])[0])
    alone.local_map.clear()
    alone.local_map.add(alone._extractor.extract(room_view(np.eye(4)).depth, DepthNoise()), far)
    assert run(alone, [np.eye(4)])[0].status is not TrackingStatus.OK


def test_after_a_correction_poses_go_on_in_the_new_world() -> None:
    poses = [se3_exp(i * np.array([0.02, 0, 0.005, 0, 0.01, 0])) for i in range(6)]
    T_new_old = se3_exp(np.array([0.5, -0.2, 0.1, 0.05, 0.3, -0.1]))
    tracker = make_tracker()
    run(tracker, poses[:3])
    tracker.move(T_new_old)
    for i, T in enumerate(poses[3:]):
        result = tracker.track(room_view(T, sigma=0.002, seed=10 + i))
        assert result.status is TrackingStatus.OK
        assert error_m(result.T_world_camera, T_new_old @ T) < 3e-3


def test_relocation_begins_a_new_local_map() -> None:
    tracker = make_tracker()
    first = run(tracker, [np.eye(4)])[0]
    with_target(tracker, first)
    jump = se3_exp(np.array([0.1, 0.05, -0.1, 0.0, -0.1, 0.2]))
    frame, noise = room_view(jump), DepthNoise()
    points = extract_points(frame.depth, CAMERA, PointSettings(), noise, tracker.context)
    assert tracker.target is not None
    found = align(points, tracker.target, jump, TrackerSettings().align, noise, tracker.context)
    result = tracker.relocate(FeatureView(frame.color, frame.depth, np.eye(4)), points, found, "keyframe 3")
    assert result.status is TrackingStatus.RECOVERED and result.reason == "keyframe 3"
    after = run(tracker, [jump])[0]
    assert after.status is TrackingStatus.OK and error_m(after.T_world_camera, jump) < 3e-3


def test_the_generated_room_is_followed(room: Path) -> None:
    sequence = open_sequence(room)
    frames = list(sequence.stream())
    tracker = FeatureTracker(sequence.camera, features=NO_LIMIT, T_world_camera=frames[0].T_world_camera)
    results = [tracker.track(frame) for frame in frames]
    assert all(r.status is not TrackingStatus.LOST for r in results)
    errors = [error_m(r.T_world_camera, f.T_world_camera) for r, f in zip(results, frames, strict=True)]
    assert max(errors) < 0.02


# --- recordings ------------------------------------------------------------------------------------------------------


def test_split_lidar_scans_a_metre_apart(shared_data: Path) -> None:
    folder = shared_data / "clouds" / "newer_college_features"
    truth = list(read_pose_graph(folder / "graph.txt").values())
    settings = replace(LIDAR, align=replace(LIDAR.align, budget_ms=0, outer_iterations=10))
    odometry = FeatureOdometry(settings, truth[0])
    for i, T in enumerate(truth):
        planes, edges = (read_raw_points(folder / f"{kind}_{10 * i:06d}.bin") for kind in ("planes", "edges"))
        odometry.locate(split_features(planes, edges, DepthNoise(0.02, 0.0)))
        assert np.linalg.norm((inverse(T) @ odometry.T_world_sensor)[:3, 3]) < 0.08


def test_a_pair_of_lidar_scans(shared_data: Path) -> None:
    folder = shared_data / "clouds" / "scan_pair"
    T = np.loadtxt(folder / "T_target_source.txt")
    settings = replace(LIDAR, align=replace(LIDAR.align, budget_ms=0, outer_iterations=10))
    extractor, odometry = LidarFeatures(32, 2160, LIDAR.extraction, DepthNoise(0.02, 0.0)), FeatureOdometry(settings)
    for name in ("target", "source"):
        odometry.locate(extractor.extract(read_point_cloud(folder / f"{name}.ply").points))
    error = se3_log(inverse(T) @ odometry.T_world_sensor)
    assert np.linalg.norm(error[:3]) < 0.06 and np.degrees(np.linalg.norm(error[3:])) < 0.5
