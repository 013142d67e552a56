# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from feature_odometry import LidarFeatures
from feature_scenes import CAMERA, lidar_scan, room_view

from ggslam.scene.camera import Camera
from ggslam.tracking.edges_planes.extraction import HALF, LineScanner, ScanLines
from ggslam.tracking.edges_planes.scans import DepthImageFeatures
from ggslam.tracking.edges_planes.settings import LIDAR, ExtractionSettings
from ggslam.tracking.settings import DepthNoise

NOISE = DepthNoise(0.002, 0.0)
PLAIN = ExtractionSettings(segments=4, roughness=0.0)


def lines_of(points: np.ndarray, sigma: float) -> ScanLines:
    """Scan lines of points [L, C, 3], distance being z."""
    p = torch.from_numpy(np.ascontiguousarray(np.moveaxis(points, 2, 0), np.float32))
    return ScanLines(p, p[2].clone(), torch.full(p.shape[1:], sigma), len(points))


def profile(z: np.ndarray, pitch: float = 0.01) -> np.ndarray:
    """One scan line [1, C, 3] of a height profile."""
    return np.stack([pitch * np.arange(len(z)), np.zeros(len(z)), z], 1)[None]


def test_curvature_is_that_of_equation_1() -> None:
    points = np.random.default_rng(0).normal(2, 0.3, (3, 60, 3))
    found = LineScanner(3, 60, PLAIN).curvature(lines_of(points, 0.01)).numpy()
    for line in range(3):
        for j in range(HALF, 60 - HALF):
            total = points[line, j - HALF : j + HALF + 1].sum(0) - 11 * points[line, j]
            assert found[line, j - HALF] == pytest.approx((total @ total) / (110 * 0.01**2), rel=2e-3)


def test_noise_alone_makes_curvature_one_and_no_edges() -> None:
    z = 2 + np.random.default_rng(0).normal(0, 0.01, 4000)
    scanner, lines = LineScanner(1, 4000, PLAIN), lines_of(profile(z), 0.01)
    assert float(scanner.curvature(lines).mean()) == pytest.approx(1, abs=0.15)
    edges, planes = scanner.scan(lines)
    assert len(edges) == 0 and len(planes) > 0


def test_a_crease_is_an_edge_and_the_greatest_of_its_neighbours() -> None:
    x = np.arange(100)
    z = 2 - 0.01 * np.abs(x - 50)
    edges, planes = LineScanner(1, 100, PLAIN).scan(lines_of(profile(z), 0.001))
    assert edges.tolist() == [50]
    assert all(abs(p - 50) > HALF for p in planes.tolist())


def test_a_gentle_bend_is_no_edge() -> None:
    x = np.arange(100)
    z = 2 - 0.003 * np.abs(x - 50)  # turns by 34 degrees
    assert len(LineScanner(1, 100, PLAIN).scan(lines_of(profile(z), 0.0001))[0]) == 0
    sharper = replace(PLAIN, edge_angle_deg=30.0)
    assert LineScanner(1, 100, sharper).scan(lines_of(profile(z), 0.0001))[0].tolist() == [50]


def test_an_occlusion_border_is_an_edge_on_its_near_side_only() -> None:
    z = np.where(np.arange(100) < 50, 1.5, 2.5)
    edges, planes = LineScanner(1, 100, PLAIN).scan(lines_of(profile(z), 0.001))
    assert edges.tolist() == [49]
    assert all(p < 45 or p > 54 for p in planes.tolist())
    without = LineScanner(1, 100, replace(PLAIN, occluding_edges=False))
    assert len(without.scan(lines_of(profile(z), 0.001))[0]) == 0


@pytest.mark.parametrize("behind", [1.5, 2.5])
def test_where_depth_is_missing_there_is_nothing(behind: float) -> None:
    z = np.full(100, 1.5)
    z[40:50] = 0
    z[50:] = behind
    points = profile(z) * (z > 0)[None, :, None]
    edges, planes = LineScanner(1, 100, PLAIN).scan(lines_of(points, 0.001))
    assert len(edges) == 0
    assert len(planes) and all(p < 35 or p > 54 for p in planes.tolist())


def test_each_segment_gives_its_share_and_neighbours_are_suppressed() -> None:
    z = 2 + np.random.default_rng(0).normal(0, 0.01, (1, 400))[0]
    settings = replace(PLAIN, planes_per_segment=3)
    _, planes = LineScanner(1, 400, settings).scan(lines_of(profile(z), 0.01))
    segment = (planes.numpy() - HALF) // -(-390 // 4)
    assert np.bincount(segment).tolist() == [3, 3, 3, 3]
    assert np.diff(np.sort(planes.numpy())).min() > HALF


def test_lines_of_another_size_are_refused() -> None:
    with pytest.raises(ValueError, match="expected"):
        LineScanner(2, 50, PLAIN).scan(lines_of(profile(np.full(50, 2.0)), 0.01))
    with pytest.raises(ValueError, match=r"\b11\b"):
        LineScanner(2, 10, PLAIN)


# --- depth images ----------------------------------------------------------------------------------------------------


def distance_to_room(points: np.ndarray) -> np.ndarray:
    """Distance of points in the first view of `room_view` to its surfaces."""
    walls = np.abs(np.array([0.6, 0.5, 2.0]) - points).min(1)
    low, high = np.array([-0.4, -0.1, 1.4]), np.array([-0.1, 0.2, 1.7])
    outside = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0), axis=1)
    inside = np.minimum(points - low, high - points).min(1)
    return np.minimum(walls, np.where(inside > 0, inside, outside))


def test_planes_of_a_depth_image_lie_on_the_surfaces_and_face_the_camera() -> None:
    frame = room_view(np.eye(4), sigma=0.004)
    found = DepthImageFeatures(CAMERA, ExtractionSettings()).extract(frame.depth, DepthNoise(0.004, 0.0))
    planes, normals = found.planes.numpy(), found.normals.numpy()
    assert len(planes) > 250
    assert np.sqrt(np.mean(distance_to_room(planes) ** 2)) < 0.002  # patches average the noise
    assert np.percentile(np.abs(normals).max(1), 10) > 0.97  # all surfaces are at right angles to an axis
    assert ((normals * planes).sum(1) < 0).all()


def test_edges_of_a_depth_image_lie_on_creases_and_near_borders() -> None:
    found = DepthImageFeatures(CAMERA, ExtractionSettings()).extract(room_view(np.eye(4)).depth, NOISE)
    x, y, z = found.edges.numpy().T
    on_crease = (np.abs(x - 0.6) + np.abs(z - 2) < 0.05) | (np.abs(y - 0.5) + np.abs(z - 2) < 0.05)
    on_crease |= np.abs(x - 0.6) + np.abs(y - 0.5) < 0.05
    on_box = (z > 1.38) & (z < 1.72) & (x < -0.08) & (x > -0.42) & (y > -0.12) & (y < 0.22)
    assert len(x) > 60 and on_crease.sum() > 20 and on_box.sum() > 20
    assert (on_crease | on_box).mean() > 0.97


def test_rows_alone_do_not_see_level_edges() -> None:
    depth = room_view(np.eye(4)).depth
    both = DepthImageFeatures(CAMERA, ExtractionSettings()).extract(depth, NOISE).edges.numpy()
    rows = DepthImageFeatures(CAMERA, ExtractionSettings(column_step=0)).extract(depth, NOISE).edges.numpy()

    def level(p: np.ndarray) -> int:
        return int(((np.abs(p[:, 1] - 0.5) + np.abs(p[:, 2] - 2) < 0.05) & (np.abs(p[:, 0] - 0.6) > 0.1)).sum())

    assert level(both) > 10 and level(rows) == 0


def test_a_larger_image_gives_about_the_same_features() -> None:
    large = Camera(640, 480, 520.0, 520.0, 319.5, 239.5)
    counts = []
    for camera in (CAMERA, large):
        depth = room_view(np.eye(4), camera=camera).depth
        found = DepthImageFeatures(camera, ExtractionSettings()).extract(depth, NOISE)
        counts.append((len(found.planes), len(found.edges)))
    assert np.allclose(counts[0], counts[1], rtol=0.25)


def test_a_depth_image_without_depth_has_no_features() -> None:
    extractor = DepthImageFeatures(CAMERA, ExtractionSettings())
    found = extractor.extract(np.zeros((240, 320), np.float32), NOISE)
    assert len(found) == 0 and found.median_depth == 0 and found.median_distance == 0
    with pytest.raises(ValueError, match="expected"):
        extractor.extract(np.zeros((10, 10), np.float32), NOISE)


# --- LiDAR -----------------------------------------------------------------------------------------------------------


def test_a_scan_in_any_order_gives_the_same_features() -> None:
    points = lidar_scan(np.eye(4), sigma=0.01)
    mixed = np.concatenate([np.random.default_rng(0).permutation(points), np.zeros((5, 3)), np.full((1, 3), np.nan)])
    extractor = LidarFeatures(32, 900, LIDAR.extraction, DepthNoise(0.01, 0.0))
    one, two = extractor.extract(points), extractor.extract(mixed)
    assert len(one.planes) > 500 and len(one.edges) > 50
    assert torch.equal(one.planes, two.planes) and torch.equal(one.edges, two.edges)


def test_edges_of_a_scan_stand_at_corners_and_pillars() -> None:
    points = lidar_scan(np.eye(4), sigma=0.01)
    edges = LidarFeatures(32, 900, LIDAR.extraction, DepthNoise(0.01, 0.0)).extract(points).edges.numpy()
    corners = [(x, y) for x in (-12, 12) for y in (-8, 8)]
    corners += [(x + i, y + j) for x, y in ((5, 3), (-6, -2)) for i in (0, 1) for j in (0, 1)]
    offset = edges[:, None, :2] - np.array(corners)
    assert np.mean(np.linalg.norm(offset, axis=2).min(1) < 0.3) > 0.85
