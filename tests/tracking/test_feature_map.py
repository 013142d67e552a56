# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ggslam.errors import ConfigError
from ggslam.tracking.edges_planes.settings import FeatureMapSettings
from ggslam.tracking.edges_planes.voxels import FeatureMap, principal_axis

SETTINGS = FeatureMapSettings(plane_voxel=0.1, edge_voxel=0.2, slots=1 << 14)


def add(table: FeatureMap, points: np.ndarray, planes: int | None = None) -> None:
    """Adds points without patches."""
    p = torch.from_numpy(np.ascontiguousarray(points, np.float32))
    table.add(p, len(p) if planes is None else planes, torch.zeros_like(p), torch.zeros(len(p)))


def slanted_plane(n: int, sigma: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points [n, 3] on a plane through (5, -3, 2), 1 m wide, and its normal."""
    rng = np.random.default_rng(seed)
    normal = np.array([1.0, 2.0, 3.0]) / np.sqrt(14)
    u = np.cross(normal, [1, 0, 0])
    u /= np.linalg.norm(u)
    v = np.cross(normal, u)
    a, b, c = rng.uniform(-0.5, 0.5, n), rng.uniform(-0.5, 0.5, n), rng.normal(0, sigma, n)
    return np.array([5.0, -3.0, 2.0]) + a[:, None] * u + b[:, None] * v + c[:, None] * normal, normal


@pytest.mark.parametrize("largest", [False, True])
def test_the_axis_is_that_of_a_library(largest: bool) -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(200, 3, 3)) * [1.0, 0.3, 0.05]
    S = A @ A.transpose(0, 2, 1)
    six = torch.from_numpy(np.stack([S[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], 1))
    values, axes = principal_axis(six.float(), torch.full((200,), largest))
    true_values, true_axes = np.linalg.eigh(S)
    assert np.allclose(values, true_values, atol=2e-5 * true_values[:, 2:].max())
    axis = true_axes[:, :, 2 if largest else 0]
    assert np.percentile(np.abs((axes.numpy() * axis).sum(1)), 5) > 0.999


def test_a_plane_is_found_with_its_normal_and_thickness() -> None:
    points, normal = slanted_plane(20000, sigma=0.004)
    table = FeatureMap(SETTINGS)
    add(table, points)
    query, _ = slanted_plane(300, sigma=0.0, seed=1)
    found = table.match(torch.from_numpy(query).float(), 300, torch.zeros(300, 3))
    assert found.found.float().mean() > 0.95
    rows = found.surfaces[found.found].numpy()
    assert np.median(np.abs(rows[:, 3:6] @ normal)) > 0.999
    assert np.sqrt(np.median(rows[:, 6])) == pytest.approx(0.004, rel=0.2)
    assert np.median(np.abs((rows[:, :3] - query[found.found.numpy()]) @ normal)) < 0.001


def test_adding_in_parts_is_adding_at_once() -> None:
    points, _ = slanted_plane(4000, sigma=0.004)
    whole, parts = FeatureMap(SETTINGS), FeatureMap(SETTINGS)
    add(whole, points)
    for part in np.array_split(points, 5):
        add(parts, part)
    query = torch.from_numpy(points[::7]).float()
    one, two = (t.match(query, len(query), torch.zeros_like(query)) for t in (whole, parts))
    both = one.found & two.found
    assert both.sum() > 300 and (one.found == two.found).float().mean() > 0.98
    assert torch.allclose(one.surfaces[both][:, :3], two.surfaces[both][:, :3], atol=1e-4)
    assert torch.allclose(one.surfaces[both][:, 6], two.surfaces[both][:, 6], rtol=0.02, atol=1e-7)


def test_an_edge_is_found_with_its_direction_and_apart_from_planes() -> None:
    rng = np.random.default_rng(0)
    direction = np.array([0.6, 0.0, 0.8])
    line = rng.uniform(0, 1, 200)[:, None] * direction + rng.normal(0, 0.003, (200, 3))
    table = FeatureMap(SETTINGS)
    add(table, line, planes=0)
    query = torch.from_numpy(line[:50]).float()
    found = table.match(query, 0, torch.zeros(50, 3))
    assert found.found.all()
    assert np.abs(found.surfaces[:, 3:6].numpy() @ direction).min() > 0.99
    assert not table.match(query, 50, torch.zeros(50, 3)).found.any()
    assert len(table.surfaces(edges=True)) > 0 and len(table.surfaces(edges=False)) == 0


def test_one_patch_makes_a_plane_and_one_point_does_not() -> None:
    point, normal = torch.tensor([[0.52, 0.31, 1.07]]), torch.tensor([[0.0, 0.6, -0.8]])
    for disc, expected in ((0.02, True), (0.0, False)):
        table = FeatureMap(SETTINGS)
        table.add(point, 1, normal if disc else torch.zeros(1, 3), torch.tensor([disc]))
        found = table.match(point + 0.01, 1, normal)
        assert bool(found.found) is expected
        if expected:
            assert torch.allclose(found.surfaces[0, 3:6], normal[0], atol=1e-5)
            assert not table.match(point + 0.01, 1, -normal).found  # the other side of it


def test_the_table_does_not_grow_and_the_newest_stays() -> None:
    table = FeatureMap(replace(SETTINGS, slots=256))
    for i in range(20):
        points, _ = slanted_plane(3000, sigma=0.0, seed=i)
        add(table, points + [3.0 * i, 0, 0])
        assert len(table) <= 256
    query = torch.from_numpy(points[:200] + [57.0, 0, 0]).float()
    assert table.match(query, 200, torch.zeros(200, 3)).found.float().mean() > 0.5
    table.clear()
    assert len(table) == 0 and not table.match(query, 200, torch.zeros(200, 3)).found.any()


def test_slots_must_be_a_power_of_two() -> None:
    with pytest.raises(ConfigError, match="slots"):
        FeatureMapSettings(slots=1000)
