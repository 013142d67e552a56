# SPDX-License-Identifier: Apache-2.0
"""Comparing clouds: generated ones, for which the right answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.evaluation.geometry import score_cloud
from ggslam.geometry.clouds import CloudTuning, overlap
from ggslam.geometry.icp import register
from ggslam.geometry.normals import estimate_normals
from ggslam.scene.poses import inverse, se3_exp
from ggslam.system.tuning import overridden


def corner(count: int = 4000, seed: int = 0) -> np.ndarray:
    """Points on three walls that meet, with a step in one, so that every motion can be seen."""
    rng = np.random.default_rng(seed)
    flat = rng.uniform(0, 2, (3, count // 3, 2))
    walls = [np.insert(flat[axis], axis, 0.0, axis=1) for axis in range(3)]
    walls[0][:, 0] += 0.3 * (walls[0][:, 1] > 1)
    return np.concatenate(walls)


def moved(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    return points @ T[:3, :3].T + T[:3, 3]


def grid(spacing: float, height: float, size: int = 60) -> np.ndarray:
    x, y = np.mgrid[:size, :size].reshape(2, -1) * spacing
    return np.stack([x, y, np.full(len(x), height)], 1)


def test_overlap_counts_and_measures() -> None:
    target = grid(0.1, 0.0)
    source = np.concatenate([grid(0.1, 0.03)[:1200], grid(0.1, 0.04)[1200:1800], grid(0.1, 0.09)[:600]])
    found = overlap(source, target, 0.05)
    assert found.fitness == pytest.approx(0.75)
    assert found.inlier_rmse_m == pytest.approx(np.sqrt((1200 * 0.03**2 + 600 * 0.04**2) / 1800))
    assert overlap(target, source, 0.05).fitness == pytest.approx(1800 / 3600)  # the other way is another question
    nothing = overlap(source + 9, target)
    assert nothing.fitness == 0 and nothing.inlier_rmse_m == 0


def test_icp_finds_the_motion() -> None:
    target, source = corner(6000, seed=1), corner(6000, seed=2)  # the same walls, other points
    T = se3_exp(np.array([0.06, -0.05, 0.08, 0.03, -0.04, 0.05]))
    found = register(moved(source, inverse(T)), target)
    assert found.converged
    error = inverse(T) @ found.T_target_source
    assert np.linalg.norm(error[:3, 3]) < 3e-3 and np.abs(error[:3, :3] - np.eye(3)).max() < 3e-3
    assert found.overlap.fitness > 0.97
    middle = moved(source, inverse(T)).mean(0)
    assert found.moved_m == pytest.approx(np.linalg.norm(moved(middle[None], T)[0] - middle), abs=5e-3)
    assert found.turned_deg == pytest.approx(np.degrees(np.sqrt(0.03**2 + 0.04**2 + 0.05**2)), abs=0.2)
    again = register(moved(source, inverse(T)), target, T_start=found.T_target_source)
    assert again.moved_m < 1e-3 and again.iterations < found.iterations


def test_icp_leaves_alone_what_nothing_holds() -> None:
    """Two planes: sliding along them changes nothing and is not done."""
    target = grid(0.02, 0.0, 80)
    found = register(target + (0.004, -0.003, 0.02), target)
    assert found.T_target_source[2, 3] == pytest.approx(-0.02, abs=1e-4)
    assert np.abs(found.T_target_source[:2, 3]).max() < 1e-6


def test_icp_of_a_sample_is_repeatable_and_scores_all_points() -> None:
    target = corner(6000)
    source = moved(target, se3_exp(np.array([0.02, 0.01, 0, 0, 0, 0.02])))
    one = register(source, target, sample=500, seed=3)
    two = register(source, target, sample=500, seed=3)
    other = register(source, target, sample=500, seed=4)
    assert (one.T_target_source == two.T_target_source).all()
    assert (one.T_target_source != other.T_target_source).any()
    assert one.overlap.fitness == pytest.approx(1.0)


def test_icp_without_common_ground_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 10 points within 0.25 m of the target, found 0 of 600"):
        register(corner(600) + 5, corner(600))
    with pytest.raises(ValueError, match="point 1 is not finite"):
        overlap(np.array([[0, 0, 0], [0, np.nan, 0]]), corner(600))
    with pytest.raises(ValueError, match="expected points"):
        overlap(corner(600), np.empty((0, 3)))
    with pytest.raises(ValueError, match="positive distance"):
        overlap(corner(600), corner(600), 0.0)


def test_scores_of_a_map_that_is_half_there() -> None:
    reference = grid(0.1, 0.0)
    estimate = np.concatenate([reference[:1800] + (0, 0, 0.015), [[0.0, 0.0, 1.0]] * 200])
    s = score_cloud(estimate, reference, (0.01, 0.02, 2.0))
    low, middle, high = s.thresholds
    assert (low.precision, low.recall, low.f1) == (0, 0, 0)
    assert middle.precision == pytest.approx(0.9) and middle.recall == pytest.approx(0.5)
    assert middle.f1 == pytest.approx(2 * 0.9 * 0.5 / 1.4)
    assert high.precision == 1 and middle.threshold_m == 0.02
    assert s.accuracy_m == pytest.approx(0.9 * 0.015 + 0.1 * 1.0) and s.accuracy_median_m == pytest.approx(0.015)
    rows = np.arange(1, 31) * 0.1  # the missing rows are this far from the last one that is there
    assert s.completeness_m == pytest.approx((30 * 0.015 + np.hypot(rows, 0.015).sum()) / 60)
    assert s.normal_consistency is None
    T = se3_exp(np.array([0.5, 0.2, -0.4, 0.3, 0.1, 0.2]))
    elsewhere = score_cloud(moved(estimate, inverse(T)), reference, (0.01, 0.02, 2.0), T_reference_estimate=T)
    assert elsewhere.accuracy_m == pytest.approx(s.accuracy_m) and elsewhere.thresholds[1].f1 == middle.f1
    assert elsewhere.completeness_m == pytest.approx(s.completeness_m)


@overridden(CloudTuning, max_queries=900)
def test_large_clouds_are_sampled() -> None:
    reference, estimate = grid(0.1, 0.0), grid(0.1, 0.0)
    estimate[::4, 2] = 0.03
    found = score_cloud(estimate, reference, (0.01,), seed=1)
    assert found.thresholds[0].precision == pytest.approx(0.75, abs=0.04)
    assert found.thresholds[0].precision != 0.75  # which all of them would give
    assert found == score_cloud(estimate, reference, (0.01,), seed=1)


def test_normals() -> None:
    points = grid(0.05, 0.0)
    up = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    tilted = points @ np.array([[1, 0, 0], [0, np.cos(0.5), -np.sin(0.5)], [0, np.sin(0.5), np.cos(0.5)]]).T
    normals = estimate_normals(tilted)
    np.testing.assert_allclose(np.abs(normals @ [0, -np.sin(0.5), np.cos(0.5)]), 1, atol=1e-6)
    s = score_cloud(points, points, estimate_normals=up, reference_normals=-up)
    assert s.normal_consistency == pytest.approx(1)  # signs do not count
    s = score_cloud(points, points, estimate_normals=up, reference_normals=np.roll(up, 1, 1))
    assert s.normal_consistency == pytest.approx(0)
