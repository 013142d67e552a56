# SPDX-License-Identifier: Apache-2.0
"""Segments of range images by the angle between neighbours: exact geometry, a slow reference, features without them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from feature_scenes import CAMERA, room_view

from ggslam.scene.camera import Camera
from ggslam.tracking.edges_planes.scans import DepthImageFeatures
from ggslam.tracking.edges_planes.segments import RangeSegments
from ggslam.tracking.edges_planes.settings import ExtractionSettings
from ggslam.tracking.settings import DepthNoise

NOISE = DepthNoise(0.002, 0.0)
ALPHA = math.radians(0.5)


def angle_deg(one: float, other: float, alpha: float) -> float:
    """beta = atan2(d2 sin(alpha), d1 - d2 cos(alpha))."""
    far, near = max(one, other), min(one, other)
    return math.degrees(math.atan2(near * math.sin(alpha), far - near * math.cos(alpha)))


def slow_labels(ranges: np.ndarray, across: float, down: float, limit_deg: float) -> np.ndarray:
    """Segments by flooding, pixel by pixel."""
    labels, count = np.zeros(ranges.shape, int), 0
    for start in np.argwhere(ranges > 0):
        if labels[tuple(start)]:
            continue
        count += 1
        labels[tuple(start)] = count
        waiting = [tuple(start)]
        while waiting:
            y, x = waiting.pop()
            for dy, dx, alpha in ((0, 1, across), (0, -1, across), (1, 0, down), (-1, 0, down)):
                v, u = y + dy, x + dx
                inside = 0 <= v < ranges.shape[0] and 0 <= u < ranges.shape[1]
                free = inside and ranges[v, u] > 0 and not labels[v, u]
                if free and angle_deg(ranges[y, x], ranges[v, u], alpha) > limit_deg:
                    labels[v, u] = count
                    waiting.append((v, u))
    return labels


@pytest.mark.parametrize("slope_deg", [5.2, 9.2, 11.2, 30.2, 80.2])
def test_a_wall_is_one_segment_as_far_as_it_is_seen_at_a_larger_angle(slope_deg: float) -> None:
    """On a plane the criterion's angle is the one between ray and plane, exactly."""
    directions = np.arange(60) * ALPHA
    # A wall through (2 m, 0) that the first ray meets at `slope_deg`; the farther along, the flatter by ALPHA a ray.
    angles = math.radians(slope_deg) - directions
    seen = angles > ALPHA
    ranges = np.where(seen, 2 * math.sin(math.radians(slope_deg)) / np.sin(np.maximum(angles, ALPHA)), 0)
    for one, other, angle in zip(ranges[seen], ranges[seen][1:], np.degrees(angles[seen][1:]), strict=False):
        assert angle_deg(one, other, ALPHA) == pytest.approx(angle, rel=1e-9)
    labels, _ = RangeSegments(ALPHA, ALPHA, 10.0).labels(ranges[None].astype(np.float32))
    together = np.count_nonzero(labels[0] == 1)
    assert together == max(1, np.count_nonzero(np.degrees(angles) > 10.0))


def test_a_step_parts_where_its_angle_says() -> None:
    """A box 2 m away before a wall: 10 degrees are reached where the wall is 2 sin(a) / tan(10) + 2 cos(a) away."""
    limit = 2 * (math.sin(ALPHA) / math.tan(math.radians(10)) + math.cos(ALPHA))
    for wall, segments in ((limit - 1e-3, 1), (limit + 1e-3, 2)):
        ranges = np.full((3, 40), wall, np.float32)
        ranges[:, 15:25] = 2.0
        labels, sizes = RangeSegments(ALPHA, 0.5, 10.0).labels(ranges)
        assert len(sizes) - 1 == (1 if segments == 1 else 3) and sizes[0] == 0 and sizes.sum() == 120
        assert (labels[:, 14] == labels[:, 15]).all() == (segments == 1)


def test_labels_are_those_of_flooding() -> None:
    rng = np.random.default_rng(0)
    ranges = (2 + np.kron(rng.integers(0, 3, (6, 8)), np.ones((4, 4))) * 0.3 + rng.normal(0, 0.02, (24, 32)))
    ranges[rng.random(ranges.shape) < 0.1] = 0
    ranges = ranges.astype(np.float32)
    labels, sizes = RangeSegments(0.02, 0.03, 25.0).labels(ranges)
    expected = slow_labels(ranges, 0.02, 0.03, 25.0)
    assert len(sizes) - 1 == expected.max() > 10
    pairs = np.unique(np.stack([labels.reshape(-1), expected.reshape(-1)], 1), axis=0)
    assert len(pairs) == len(sizes) and (np.bincount(labels.reshape(-1)) == sizes).all()  # one to one
    kept = RangeSegments(0.02, 0.03, 25.0).without_small(ranges, 9)
    counts = np.bincount(expected.reshape(-1))
    np.testing.assert_array_equal(kept, (expected > 0) & (counts[expected] >= 9))


def specks(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """A room with patches of 3 x 8 pixels of a 320-pixel-wide image half a metre before what is there, and where they
    are."""
    depth, mask = room_view(np.eye(4), camera=camera).depth, np.zeros((240, 320), bool)
    for v in range(12, 230, 21):
        for u in range(10, 300, 31):
            mask[v : v + 3, u : u + 8] = True
    times = camera.width // 320
    mask = mask.repeat(times, 0).repeat(times, 1)
    return np.where(mask, depth - 0.5, depth).astype(np.float32), mask


def pixels_of(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    u = np.rint(points[:, 0] / points[:, 2] * camera.fx + camera.cx).astype(int)
    v = np.rint(points[:, 1] / points[:, 2] * camera.fy + camera.cy).astype(int)
    return v, u


@pytest.mark.parametrize("times", [1, 2])
def test_small_segments_have_no_features(times: int) -> None:
    camera = CAMERA if times == 1 else Camera(640, 480, 520.0, 520.0, 319.5, 239.5)
    depth, (spoilt, mask) = room_view(np.eye(4), camera=camera).depth, specks(camera)
    usual = ExtractionSettings()
    segmented = replace(usual, segment_angle_deg=10.0)
    plain = DepthImageFeatures(camera, usual).extract(spoilt, NOISE)
    assert mask[pixels_of(plain.edges.numpy(), camera)].sum() > 20  # borders of specks, which pass for edges
    found = DepthImageFeatures(camera, segmented).extract(spoilt, NOISE)
    for points in (found.edges.numpy(), found.planes.numpy()):
        assert not mask[pixels_of(points, camera)].any()
    clean = DepthImageFeatures(camera, segmented).extract(depth, NOISE)
    same = DepthImageFeatures(camera, usual).extract(depth, NOISE)
    assert len(clean) == len(same) > 300  # a room without specks is as it was
    np.testing.assert_array_equal(clean.planes.numpy(), same.planes.numpy())
    np.testing.assert_array_equal(clean.edges.numpy(), same.edges.numpy())


def test_what_was_not_measured_joins_nothing() -> None:
    ranges = np.full((9, 40), 2.0, np.float32)
    ranges[:, 20] = 0
    _, sizes = RangeSegments(ALPHA, ALPHA, 10.0).labels(ranges)
    assert sizes.tolist() == [9, 180, 171]


def test_noise_does_not_part_a_wall_and_a_step_beyond_it_does() -> None:
    rng, alpha = np.random.default_rng(0), 0.0033
    wall = (6 + rng.normal(0, 0.07, (60, 80))).astype(np.float32)  # as a Kinect sees it: neighbours 2 cm apart
    segments, noise = RangeSegments(alpha, alpha, 10.0), np.full((60, 80), 4 * 0.07, np.float32)
    assert segments.without_small(wall, 30).mean() < 0.99
    _, sizes = segments.labels(wall, noise)
    assert sizes.tolist() == [0, 4800]
    wall[20:40, 30:50] -= 1.0
    _, sizes = segments.labels(wall, noise)
    assert sizes.tolist() == [0, 4400, 400]
