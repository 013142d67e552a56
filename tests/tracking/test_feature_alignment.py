# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from feature_odometry import FeatureOdometry, LidarFeatures, split_features
from feature_scenes import CAMERA, lidar_scan, room_view

from ggslam.scene.poses import inverse, se3_exp, se3_log, turning_angle
from ggslam.tracking.edges_planes import alignment as feature_alignment
from ggslam.tracking.edges_planes.alignment import FrameClock, _pose_matrix
from ggslam.tracking.edges_planes.extraction import ScanFeatures
from ggslam.tracking.edges_planes.local_map import LocalFeatureMap
from ggslam.tracking.edges_planes.scans import DepthImageFeatures
from ggslam.tracking.edges_planes.settings import LIDAR, FeatureAlignSettings, FeatureTrackerSettings
from ggslam.tracking.settings import DepthNoise

NO_LIMIT = FeatureTrackerSettings(align=FeatureAlignSettings(budget_ms=0))
NOISE = DepthNoise(0.002, 0.0)
EXTRACTOR = DepthImageFeatures(CAMERA, NO_LIMIT.extraction)


def view(T: np.ndarray, corner: bool = True) -> ScanFeatures:
    return EXTRACTOR.extract(room_view(T, corner, sigma=0.002).depth, NOISE)


def test_the_derivatives_are_those_of_the_distances() -> None:
    rng = np.random.default_rng(0)
    axis, q, offset = rng.normal(size=3), rng.normal(size=3), 0.7
    row = np.concatenate([np.outer(axis, q).ravel(), axis, [offset]])
    T = se3_exp(rng.normal(size=6))

    def residual(twist: np.ndarray) -> float:
        R = se3_exp(np.concatenate([np.zeros(3), twist[3:]]))[:3, :3] @ T[:3, :3]
        return float(axis @ (R @ q + T[:3, 3] + twist[:3]) - offset)

    found = row @ _pose_matrix(T)
    assert found[6] == pytest.approx(residual(np.zeros(6)), abs=1e-5)
    for k in range(6):
        step = 1e-5 * np.eye(6)[k]
        assert found[k] == pytest.approx((residual(step) - residual(-step)) / 2e-5, abs=1e-4)


def test_a_known_motion_is_found() -> None:
    local_map, truth = LocalFeatureMap(NO_LIMIT), se3_exp(np.array([0.02, -0.015, 0.01, 0.01, -0.015, 0.02]))
    local_map.add(view(np.eye(4)), np.eye(4))
    found = local_map.align(view(truth), np.eye(4))
    assert np.linalg.norm(se3_log(inverse(truth) @ found.T_map_sensor)[:3]) < 1e-3
    assert found.usable and found.overlap > 0.85 and found.rmse < 0.003
    assert len(found.weak_directions) == 0 and found.visibility[0] > 0.01
    assert found.outer_iterations <= 2


def test_a_map_that_was_moved_gives_poses_that_moved_along() -> None:
    local_map, T_new_old = LocalFeatureMap(NO_LIMIT), se3_exp(np.array([1.0, 2.0, -0.5, 0.3, -0.8, 0.4]))
    local_map.add(view(np.eye(4)), np.eye(4))
    scan = view(se3_exp(np.array([0.01, 0, 0, 0, 0.01, 0])))
    before = local_map.align(scan, np.eye(4))
    local_map.move(T_new_old)
    after = local_map.align(scan, T_new_old)
    assert np.allclose(after.T_map_sensor, T_new_old @ before.T_map_sensor, atol=1e-5)
    A = np.kron(np.eye(2), T_new_old[:3, :3])
    assert np.allclose(after.information, A @ before.information @ A.T, rtol=1e-3, atol=1e-3 * before.information.max())


def test_a_bare_wall_leaves_three_directions_open() -> None:
    local_map = LocalFeatureMap(NO_LIMIT)
    local_map.add(view(np.eye(4), corner=False), np.eye(4))
    found = local_map.align(view(np.eye(4), corner=False), np.eye(4))
    assert len(found.weak_directions) == 3
    normal = np.abs(found.weak_directions)
    assert np.all(normal[:, 2] < 0.05)  # towards the wall is seen
    assert np.all(normal[:, 3:5] < 0.05)  # and so is tilting


def test_edges_see_what_planes_do_not() -> None:
    """Points of a wall, and of a line on it: without the line nothing says where along the wall one is."""
    rng = np.random.default_rng(0)
    wall = np.stack([rng.uniform(-1, 1, 3000), rng.uniform(-1, 1, 3000), np.full(3000, 2.0)], 1)
    line = np.stack([np.full(400, 0.3), rng.uniform(-1, 1, 400), np.full(400, 2.0)], 1)
    move = np.array([0.03, 0.0, 0.01])
    errors = {}
    for weight in (0.0, 1.0):
        local_map = LocalFeatureMap(replace(NO_LIMIT, align=replace(NO_LIMIT.align, edge_weight=weight)))
        local_map.add(split_features(wall, line, NOISE), np.eye(4))
        found = local_map.align(split_features(wall - move, line - move, NOISE), np.eye(4))
        errors[weight] = np.abs(found.T_map_sensor[:3, 3] - move)
    assert errors[1.0][0] < 1e-3 and errors[0.0][0] > 4e-3  # of 3 cm; how far it slides depends on rounding
    assert errors[0.0][2] < 2e-3


def test_outliers_do_not_pull() -> None:
    local_map = LocalFeatureMap(NO_LIMIT)
    local_map.add(view(np.eye(4)), np.eye(4))
    scan = view(np.eye(4))
    planes = scan.planes.clone()
    planes[::4, :] *= 0.985  # a quarter of all points lies 1 to 3 cm off
    moved = ScanFeatures(planes, scan.normals, scan.discs, scan.plane_sigmas, scan.edges, scan.edge_sigmas)
    found = local_map.align(moved, np.eye(4))
    assert np.linalg.norm(found.T_map_sensor[:3, 3]) < 2e-3
    assert 0.7 < found.overlap < 0.9


# --- time ------------------------------------------------------------------------------------------------------------


def test_the_clock_lets_begin_what_is_likely_to_end(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(feature_alignment.time, "perf_counter", lambda: now[0])
    clock = FrameClock(10)
    assert clock.allows("step")
    now[0] = 0.004
    clock.end_step("step")
    assert clock.allows("step")  # 4 ms used, 4 ms more
    now[0] = 0.007
    assert not clock.allows("step")
    clock.lift()
    assert clock.allows("step")
    clock.start()
    assert clock.allows("step")
    now[0] += 0.0065
    assert not clock.allows("step")


def test_without_time_one_matching_and_one_step_are_made() -> None:
    settings = replace(NO_LIMIT, align=replace(NO_LIMIT.align, budget_ms=1e-6, rematch_share=0.0))
    local_map = LocalFeatureMap(settings)
    local_map.clock.start()
    local_map.add(view(np.eye(4)), np.eye(4))
    scan = view(se3_exp(np.array([0.03, 0, 0, 0, 0, 0])))
    hurried = local_map.align(scan, np.eye(4))
    assert (hurried.outer_iterations, hurried.inner_iterations) == (1, 1)
    assert not local_map.update(scan, se3_exp(np.array([0.5, 0, 0, 0, 0, 0])), 0.75)
    assert local_map.update(scan, hurried.T_map_sensor, 0.1)  # the map must not run dry
    local_map.clock.lift()
    calm = local_map.align(scan, np.eye(4))
    assert calm.outer_iterations == 2 and calm.inner_iterations > 1


# --- LiDAR -----------------------------------------------------------------------------------------------------------


def test_a_lidar_is_followed_through_a_hall() -> None:
    settings = replace(LIDAR, align=replace(LIDAR.align, budget_ms=0))
    extractor = LidarFeatures(32, 900, LIDAR.extraction, DepthNoise(0.01, 0.0))
    poses = [se3_exp(i * np.array([0.25, 0.08, 0.01, 0, 0, 0.03])) for i in range(6)]
    odometry = FeatureOdometry(settings, poses[0])
    for T in poses:
        found = odometry.locate(extractor.extract(lidar_scan(T, sigma=0.01)))
        assert found is None or odometry.map.is_convincing(found)
        error = inverse(T) @ odometry.T_world_sensor
        assert np.linalg.norm(error[:3, 3]) < 0.04 and turning_angle(error, np.eye(4)) < 0.005


def test_a_lidar_that_sees_something_else_stays_where_it_was() -> None:
    extractor = LidarFeatures(32, 900, LIDAR.extraction, DepthNoise(0.01, 0.0))
    odometry = FeatureOdometry(LIDAR)
    odometry.locate(extractor.extract(lidar_scan(np.eye(4))))
    found = odometry.locate(extractor.extract(lidar_scan(np.eye(4)) * 0.3))
    assert found is not None and not odometry.map.is_convincing(found)
    assert np.array_equal(odometry.T_world_sensor, np.eye(4))
