# SPDX-License-Identifier: Apache-2.0
"""The local map of edges and planes and alignments to it by the CUDA kernels, held against the CPU's and the truth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from device_features import NO_LIMIT, Sides, apart, on_device
from feature_odometry import LidarFeatures, split_features
from feature_scenes import lidar_scan, room_view

from ggslam.cuda.library import CudaLibrary
from ggslam.scene.frame import Frame
from ggslam.scene.poses import se3_exp
from ggslam.tracking.edges_planes.alignment import FeatureAlignment
from ggslam.tracking.edges_planes.local_map import LocalFeatureMap
from ggslam.tracking.edges_planes.settings import LIDAR, FeatureTrackerSettings
from ggslam.tracking.settings import DepthNoise

NOISE = DepthNoise(0.002, 0.0)
STEP = np.array([0.02, -0.01, 0.008, 0.01, 0.015, 0.005])
MOST_M, MOST_RAD = 2e-5, 2e-5
"""Between poses of both sides: what a few features may pull that rounding gives another match."""


def depth_at(T: np.ndarray, seed: int = 0, corner: bool = True, sigma: float = 0.002) -> np.ndarray:
    return room_view(T, corner, sigma=sigma, seed=seed).depth


def check_aligned(found: FeatureAlignment, expected: FeatureAlignment) -> None:
    shift, turn = apart(expected.T_map_sensor, found.T_map_sensor)
    assert shift < MOST_M and turn < MOST_RAD
    assert (found.usable, found.converged) == (expected.usable, expected.converged)
    assert found.outer_iterations == expected.outer_iterations
    assert found.inner_iterations == expected.inner_iterations
    assert found.overlap == pytest.approx(expected.overlap, abs=5e-3)
    assert found.rmse == pytest.approx(expected.rmse, rel=1e-2, abs=1e-7)
    for name in ("information", "visibility"):
        one, two = getattr(found, name), getattr(expected, name)
        assert np.allclose(one, two, rtol=1e-3, atol=1e-3 * np.abs(two).max() + 1e-12), name
    assert len(found.weak_directions) == len(expected.weak_directions)


def check_tables(sides: Sides, voxels: int, variance: float = 1e-8) -> None:
    """The same voxels in the same slots, but for one in a thousand: a point within rounding of a border. `variance`:
    that rounding makes, square metres."""
    plain = sides.plain_map.features
    assert plain is not None
    sides.device.flush()
    keys, weights, surfaces, scatters = (array.cpu() for array in sides.device.table)
    used, same = plain._keys != -1, keys == plain._keys
    assert int(used.sum()) > voxels and int((~same).sum()) <= 0.001 * int(used.sum())
    both = used & same & (weights[:, 0] == plain._weight)
    assert int(both.sum()) > 0.99 * int(used.sum())
    one, other = surfaces[both], plain._surface[both]
    assert torch.allclose(one[:, :3], other[:, :3], atol=3e-6) and torch.equal(one[:, 7], other[:, 7])
    assert torch.allclose(scatters[both], plain._scatter[both], atol=3e-6, rtol=1e-4)
    surface = (one[:, 6] > 0) & (other[:, 6] > 0)
    assert int(((one[:, 6] > 0) == (other[:, 6] > 0)).sum()) >= 0.998 * len(one)
    assert torch.allclose(one[surface, 6], other[surface, 6], rtol=1e-3, atol=variance)
    turned = 1 - (one[surface, 3:6] * other[surface, 3:6]).sum(1).abs()
    assert float(turned.quantile(0.99)) < 1e-5
    with_patch = surface & (one[:, 7] > 0)
    assert ((one[with_patch, 3:6] * other[with_patch, 3:6]).sum(1) > 0).all()  # towards the sensor on both


def test_a_motion_is_followed_as_on_the_cpu(cuda_library: CudaLibrary) -> None:
    sides, T = Sides.of(cuda_library), np.eye(4)
    for i in range(7):
        truth = se3_exp(i * STEP)
        scans = sides.scans(depth_at(truth, i), NOISE)
        if i == 0:
            sides.add(scans, truth)
            continue
        found, expected = sides.align(scans, T @ se3_exp(STEP))
        check_aligned(found, expected)
        shift, turn = apart(truth, found.T_map_sensor)
        assert shift < 1.2e-3 and turn < 1e-3
        T = expected.T_map_sensor
        assert sides.map.update(scans[0], T, found.overlap) == sides.plain_map.update(scans[1], T, expected.overlap)
    check_tables(sides, 700)


def test_a_recording_is_followed_as_on_the_cpu(cuda_library: CudaLibrary, frames: list[Frame]) -> None:
    noise = DepthNoise()
    sides, T = Sides.of(cuda_library, camera=frames[0].camera), None
    for frame in frames:
        assert frame.T_world_camera is not None
        scans = sides.scans(frame.depth, noise)
        if T is None:
            T = frame.T_world_camera
        else:
            found, expected = sides.align(scans, T)
            check_aligned(found, expected)
            assert apart(frame.T_world_camera, found.T_map_sensor)[0] < 0.02
            T = expected.T_map_sensor
        sides.add(scans, T)
    check_tables(sides, 400)


def test_exact_depth_gives_the_exact_pose(cuda_library: CudaLibrary) -> None:
    features = on_device(cuda_library)
    local_map, truth = LocalFeatureMap(NO_LIMIT, features), se3_exp(0.2 * STEP)
    local_map.add(features.extract(depth_at(np.eye(4), sigma=0.0), NOISE), np.eye(4))
    found = local_map.align(features.extract(depth_at(truth, sigma=0.0), NOISE), np.eye(4))
    shift, turn = apart(truth, found.T_map_sensor)
    assert shift < 3e-4 and turn < 2e-4 and found.overlap > 0.85


@pytest.mark.parametrize("change", [
    {"edge_weight": 0.0}, {"edge_weight": 5.0}, {"planes": 100, "edges": 30},
    {"outer_iterations": 6, "rematch_share": 0.0},
    {"inner_iterations": 1}, {"inner_iterations": 5, "translation_tolerance": 0.0}, {"huber_sigmas": 0.3},
    {"gate_constant": 0.001, "gate_sigmas": 1.0}, {"overlap_sigmas": 0.1, "overlap_constant": 0.0},
    {"degenerate_below": 0.2}, {"min_matches": 5000},
])  # fmt: skip
def test_every_setting_of_the_alignment_means_the_same(cuda_library: CudaLibrary, change: dict[str, Any]) -> None:
    sides = Sides.of(cuda_library, replace(NO_LIMIT, align=replace(NO_LIMIT.align, **change)))
    sides.add(sides.scans(depth_at(np.eye(4)), NOISE), np.eye(4))
    check_aligned(*sides.align(sides.scans(depth_at(se3_exp(STEP), 1), NOISE), np.eye(4)))


@pytest.mark.parametrize("change", [
    {"slots": 256}, {"plane_voxel": 0.3, "edge_voxel": 0.05}, {"match_voxels": 0.8}, {"min_normal_dot": 0.999},
    {"max_weight": 2.0}, {"min_edge_points": 2.0, "edge_ratio": 1.5}, {"plane_ratio": 300.0},
])  # fmt: skip
def test_every_setting_of_the_map_means_the_same(cuda_library: CudaLibrary, change: dict[str, Any]) -> None:
    sides = Sides.of(cuda_library, replace(NO_LIMIT, map=replace(NO_LIMIT.map, **change)))
    for i in range(3):
        truth = se3_exp(i * STEP)
        sides.add(sides.scans(depth_at(truth, i), NOISE), truth)
    check_aligned(*sides.align(sides.scans(depth_at(se3_exp(3 * STEP), 9), NOISE), se3_exp(2.5 * STEP)))
    check_tables(sides, 80)


def test_a_bare_wall_leaves_three_directions_open(cuda_library: CudaLibrary) -> None:
    sides = Sides.of(cuda_library)
    scans = sides.scans(depth_at(np.eye(4), corner=False), NOISE)
    sides.add(scans, np.eye(4))
    found, expected = sides.align(sides.scans(depth_at(np.eye(4), 1, corner=False), NOISE), np.eye(4))
    assert len(found.weak_directions) == len(expected.weak_directions) == 3
    assert np.all(np.abs(found.weak_directions[:, 2:5]) < 0.05)  # towards the wall and tilting are seen
    assert abs(found.T_map_sensor[2, 3]) < 1e-3


@pytest.mark.parametrize("kept", [0, 1, 1600])
def test_few_features_and_none(cuda_library: CudaLibrary, kept: int) -> None:
    sides = Sides.of(cuda_library)
    depth = depth_at(np.eye(4))
    few = np.where(np.arange(depth.size).reshape(depth.shape) < kept, depth, 0).astype(np.float32)
    guess = se3_exp(STEP)
    nothing = sides.align(sides.scans(few, NOISE), guess)  # the map is empty
    sides.add(sides.scans(few, NOISE), np.eye(4))
    hardly = sides.align(sides.scans(depth, NOISE), guess)
    sides.add(sides.scans(depth, NOISE), np.eye(4))
    for found, expected in (nothing, hardly, sides.align(sides.scans(few, NOISE), guess)):
        check_aligned(found, expected)
        assert not found.usable and np.allclose(found.T_map_sensor, guess) and np.isfinite(found.information).all()


def test_a_map_that_was_moved_gives_poses_that_moved_along(cuda_library: CudaLibrary) -> None:
    sides, T_new_old = Sides.of(cuda_library), se3_exp(np.array([1.0, 2.0, -0.5, 0.3, -0.8, 0.4]))
    sides.add(sides.scans(depth_at(np.eye(4)), NOISE), np.eye(4))
    for side in (sides.map, sides.plain_map):
        side.move(T_new_old)
    truth = T_new_old @ se3_exp(0.5 * STEP)
    found, expected = sides.align(sides.scans(depth_at(se3_exp(0.5 * STEP), 1), NOISE), T_new_old)
    check_aligned(found, expected)
    assert apart(truth, found.T_map_sensor)[0] < 1e-3
    assert np.allclose(sides.device.world_pose(), found.T_map_sensor, atol=1e-12)  # what evidence is made at


def test_nothing_is_left_after_clearing(cuda_library: CudaLibrary) -> None:
    sides = Sides.of(cuda_library)
    scans = sides.scans(depth_at(np.eye(4)), NOISE)
    sides.add(scans, np.eye(4))
    assert sides.align(scans, np.eye(4))[0].usable
    sides.add(scans, se3_exp(np.array([5.0, 0, 0, 0, 0, 0])))  # still to be done when the map is cleared
    for side in (sides.map, sides.plain_map):
        side.clear()
    found, expected = sides.align(scans, np.eye(4))
    assert not found.usable and not expected.usable and found.overlap == expected.overlap == 0
    sides.add(scans, np.eye(4))
    sides.add(scans, se3_exp(STEP))  # two between two alignments
    check_aligned(*sides.align(scans, np.eye(4)))
    check_tables(sides, 700)


def test_alignments_repeat_bit_for_bit_in_any_order_of_threads(other_order: None) -> None:
    from cuda_emulation import emulated_library

    library, found = emulated_library(), []
    for order in (None, 0):
        if order is not None:
            library.functions.ggslam_emulation_order(order)
        features = on_device(library)
        local_map = LocalFeatureMap(NO_LIMIT, features)
        for i in range(3):
            local_map.add(features.extract(depth_at(se3_exp(i * STEP), i), NOISE), se3_exp(i * STEP))
        aligned = local_map.align(features.extract(depth_at(se3_exp(3 * STEP), 5), NOISE), se3_exp(2 * STEP))
        tables = [array.cpu().numpy().tobytes() for array in features.table]
        found.append((aligned.T_map_sensor.tobytes(), aligned.information.tobytes(), aligned.rmse, *tables))
    assert found[0] == found[1]


# --- LiDAR: features that the host has --------------------------------------------------------------------------------


def test_a_lidar_is_followed_through_a_hall(cuda_library: CudaLibrary) -> None:
    settings: FeatureTrackerSettings = replace(LIDAR, align=replace(LIDAR.align, budget_ms=0))
    extractor = LidarFeatures(32, 900, LIDAR.extraction, DepthNoise(0.01, 0.0))
    sides, T = Sides.of(cuda_library, settings), np.eye(4)
    for i in range(4):
        truth = se3_exp(i * np.array([0.25, 0.08, 0.01, 0, 0, 0.03]))
        scan = extractor.extract(lidar_scan(truth, sigma=0.01))
        scans = sides.device.take(scan), scan
        assert scans[0].median_distance == pytest.approx(scan.median_distance, rel=1e-6)
        if i:
            found, expected = sides.align(scans, T)
            check_aligned(found, expected)
            assert apart(truth, found.T_map_sensor)[0] < 0.04
            T = expected.T_map_sensor
        sides.add(scans, T)
    check_tables(sides, 200, variance=1e-7)  # of voxels of 2 m


def test_edges_see_what_planes_do_not(cuda_library: CudaLibrary) -> None:
    rng = np.random.default_rng(0)
    wall = np.stack([rng.uniform(-1, 1, 3000), rng.uniform(-1, 1, 3000), np.full(3000, 2.0)], 1)
    line = np.stack([np.full(400, 0.3), rng.uniform(-1, 1, 400), np.full(400, 2.0)], 1)
    move = np.array([0.03, 0.0, 0.01])
    features = on_device(cuda_library)
    local_map = LocalFeatureMap(NO_LIMIT, features)
    local_map.add(features.take(split_features(wall, line, NOISE)), np.eye(4))
    found = local_map.align(features.take(split_features(wall - move, line - move, NOISE)), np.eye(4))
    assert np.abs(found.T_map_sensor[:3, 3] - move)[[0, 2]].max() < 1e-3
