# SPDX-License-Identifier: Apache-2.0
"""Targets composed of parts: to the bit what they are when made at once, whatever came and went before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ggslam.native.loader import NativeContext, available_instruction_sets
from ggslam.scene.poses import se3_exp
from ggslam.tracking.gicp import GicpTarget, align
from ggslam.tracking.scan_points import ScanSettings, scan_points
from ggslam.tracking.settings import AlignSettings, DepthNoise, TargetSettings
from ggslam.tracking.surface import quaternions_from_normals
from ggslam.tracking.target_parts import TargetPart, composed_target

ALONE = TargetSettings(voxel=0.15, neighbour_weight=0.0)
WITH_NEIGHBOURS = replace(ALONE, neighbour_weight=0.3)
EDGE = 1.0

Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def surface() -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of a floor and two thin walls, both sides of them, 9 x 6 x 2 m about the origin."""
    generator = np.random.default_rng(1)
    points = (generator.random((30_000, 3)) - 0.5) * [9, 6, 2]
    normals = np.zeros_like(points)
    kind = np.arange(len(points)) % 5
    points[kind == 0, 2], normals[kind == 0, 2] = -1, 1
    for number, (axis, at, side) in enumerate([(1, 0.71, 1), (1, 0.67, -1), (0, -1.13, 1), (0, -1.17, -1)], 1):
        points[kind == number, axis], normals[kind == number, axis] = at, side
    return (points + generator.normal(0, 0.003, points.shape)).astype(np.float32), normals.astype(np.float32)


def gaussians(points: np.ndarray, normals: np.ndarray) -> Arrays:
    scales = np.tile(np.log(0.15 * np.array([1, 1, 0.1])), (len(points), 1))
    arrays = (points, quaternions_from_normals(normals), scales, np.full(len(points), 3.0))
    return tuple(np.ascontiguousarray(a, np.float32) for a in arrays)  # type: ignore[return-value]


def cells() -> list[Arrays]:
    """The surface cut in cells of 1 m that reach 20 cm into their neighbours, and one without points."""
    points, normals = surface()
    found = []
    for x in range(-5, 5):
        for y in range(-3, 3):
            low = np.array([x, y]) * EDGE
            inside = ((points[:, :2] >= low - 0.2) & (points[:, :2] < low + EDGE + 0.2)).all(1)
            found.append(gaussians(points[inside], normals[inside]))
    return [*found, gaussians(points[:0], normals[:0])]


def parts_of(arrays: list[Arrays], settings: TargetSettings, context: NativeContext) -> list[TargetPart]:
    ranks = np.random.default_rng(2).permutation(len(arrays)).tolist()
    return [TargetPart(*a, settings, context, rank) for a, rank in zip(arrays, ranks, strict=True)]


def same_bits(one: GicpTarget, other: GicpTarget) -> bool:
    return all(
        one.voxels(level)[name].tobytes() == other.voxels(level)[name].tobytes()
        for level in (0, 1)
        for name in one.voxels(level)
    )


@pytest.fixture(scope="module")
def context() -> NativeContext:
    return NativeContext(2)


@pytest.mark.parametrize("settings", [ALONE, WITH_NEIGHBOURS])
@pytest.mark.parametrize("instruction_set", available_instruction_sets())
def test_a_random_walk_of_additions_and_removals_is_a_target_made_at_once(
    settings: TargetSettings, instruction_set: str
) -> None:
    context = NativeContext(2, instruction_set)
    parts = parts_of(cells(), settings, context)
    generator = np.random.default_rng(3)
    chosen, target, counts = set(range(20)), None, set()
    for step in range(40):
        target = composed_target([parts[i] for i in generator.permutation(sorted(chosen))], settings, context, target)
        fresh = composed_target([parts[i] for i in sorted(chosen)], settings, NativeContext(1, instruction_set))
        assert same_bits(target, fresh)
        counts.add(len(target))
        chosen ^= set(generator.choice(len(parts), generator.integers(1, 6), replace=False).tolist())
        if step == 30:
            chosen = set()
    assert len(counts) > 30 and min(counts) < 1000 < max(counts)


def scan() -> np.ndarray:
    """A sensor's view of the surface from 0.4 m above the origin: what faces it and is within 3 m."""
    points, normals = surface()
    rays = points - np.array([0, 0, 0.4], np.float32)
    seen = ((rays * normals).sum(1) < -0.05) & (np.linalg.norm(rays, axis=1) < 3)
    return np.ascontiguousarray(rays[seen][::3])


@pytest.mark.parametrize("settings", [ALONE, WITH_NEIGHBOURS])
def test_poses_and_matches_are_the_same_after_a_walk(settings: TargetSettings, context: NativeContext) -> None:
    parts = parts_of(cells(), settings, context)
    walked = None
    for chosen in (parts[:30], parts[10:50], parts[40:], parts):
        walked = composed_target(chosen, settings, context, walked)
    fresh = composed_target(parts, settings, context)
    source = scan_points(scan(), ScanSettings(voxel=0.1))
    guess = se3_exp(np.array([0.05, -0.04, 0.43, 0.02, -0.01, 0.03]))
    options = (AlignSettings(min_normal_dot=0.0), DepthNoise(0.02, 0.0), context)
    one, other = (align(source, target, guess, *options) for target in (walked, fresh))
    voxels = one.matches.read().voxels
    assert np.array_equal(one.T_world_camera, other.T_world_camera)
    assert np.array_equal(voxels, other.matches.read().voxels)
    assert np.linalg.norm(one.T_world_camera[:3, 3] - [0, 0, 0.4]) < 0.01 and one.overlap > 0.9
    for level in (0, 1):  # a match is a row of what `voxels` gives
        assert len(fresh.voxels(level)["means"]) == len(walked.voxels(level)["means"])
    matched = voxels >= 0
    p = source.points @ one.T_world_camera[:3, :3].T + one.T_world_camera[:3, 3]
    assert np.linalg.norm(walked.voxels()["means"][voxels[matched]] - p[matched], axis=1).max() < 0.16


@pytest.mark.parametrize("settings", [ALONE, WITH_NEIGHBOURS])
def test_disjoint_parts_are_the_target_of_all_gaussians(settings: TargetSettings, context: NativeContext) -> None:
    points, normals = surface()
    # Of surfaces that meet in a voxel the first one decides what counts, and the order differs: none meet here.
    kept = (normals[:, 2] > 0) | ((normals[:, 1] > 0) & (points[:, 2] > -0.6))
    points, normals = points[kept], normals[kept]
    cell = np.floor(points[:, 0] / EDGE).astype(int)
    arrays = [gaussians(points[cell == c], normals[cell == c]) for c in np.unique(cell)]
    composed = composed_target(parts_of(arrays, settings, context), settings, context)
    whole = GicpTarget.from_arrays(*gaussians(points, normals), settings, context)
    for level in (0, 1):
        one, other = composed.voxels(level), whole.voxels(level)
        assert len(one["weights"]) == len(other["weights"])
        distance, nearest = cKDTree(other["means"]).query(one["means"])
        assert len(set(nearest)) == len(nearest) and distance.max() < 1e-3
        for name, tolerance in (("weights", 1e-3), ("covariances", 1e-3), ("normals", 1e-3)):
            np.testing.assert_allclose(one[name], other[name][nearest], rtol=tolerance, atol=tolerance, err_msg=name)


def test_parts_that_do_not_belong_together_are_refused(context: NativeContext) -> None:
    arrays = cells()[:2]
    one, other = parts_of(arrays, ALONE, context)
    twin = TargetPart(*arrays[1], ALONE, context, one.rank)
    foreign = TargetPart(*arrays[1], WITH_NEIGHBOURS, context, other.rank)
    assert one.nbytes > 88 * len(composed_target([one], ALONE, context))
    for parts, reason in (([one, twin], "rank"), ([one, foreign], "settings")):
        with pytest.raises(ValueError, match=reason):
            composed_target(parts, ALONE, context)
    built = GicpTarget.from_arrays(*arrays[0], ALONE, context)
    with pytest.raises(ValueError, match="composed"):
        composed_target([one], ALONE, context, built)
    with pytest.raises(ValueError, match="composed"):
        GicpTarget.from_arrays(*arrays[0], ALONE, context, base=composed_target([one], ALONE, context))
