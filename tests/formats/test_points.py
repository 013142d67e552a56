# SPDX-License-Identifier: Apache-2.0
"""Clouds sampled from a map cover its surfaces without holes, on one grid, with the right colours and ids."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ggslam.errors import FormatError
from ggslam.formats.ply import read_ply, write_ply
from ggslam.formats.point_ply import read_points, sample_points, write_points
from ggslam.formats.point_sampling import MapPart, PointSamplingTuning, sample_parts
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.tuning import overridden


def one(mean: list[float], scales: list[float], opacity: float, rgb: list[float], label: int = 0) -> GaussianMap:
    out = GaussianMap()
    add(out, mean, scales, opacity, rgb, label)
    return out


def add(
    out: GaussianMap, mean: list[float], scales: list[float], opacity: float, rgb: list[float], label: int = 0,
    quaternion: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0),
) -> None:  # fmt: skip
    out.insert(
        torch.tensor([mean]), torch.tensor([quaternion]), torch.tensor([scales]).log(),
        torch.tensor([opacity]).logit(), torch.tensor([rgb]), object_id=torch.tensor([label]),
    )  # fmt: skip


def test_small_gaussians_become_their_means() -> None:
    cloud = sample_points(one([0.512, -0.268, 1.0], [1e-4, 1e-4, 1e-4], 0.9, [1.0, 0.5, 0.0]), 0.01)
    np.testing.assert_allclose(cloud.points, [[0.51, -0.27, 1.0]], atol=1e-12)
    assert cloud.colors.tolist() == [[255, 128, 0]] and cloud.object_id is None
    assert len(sample_points(one([0, 0, 0], [1, 1, 1], 0.2, [0, 0, 0]), 0.01)) == 0
    assert len(sample_points(GaussianMap(), 0.01, with_object_id=True)) == 0


def test_a_turned_disc_is_covered_without_holes() -> None:
    quaternion = np.array([0.9, 0.2, -0.3, 0.25])
    gaussians = GaussianMap()
    add(gaussians, [0.1, 0.2, 0.3], [0.05, 0.05, 1e-4], 0.9, [0.5, 0.5, 0.5], quaternion=tuple(quaternion))
    voxel = 0.005
    cloud = sample_points(gaussians, voxel, minimum_opacity=0.3)
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    normal = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    offset = cloud.points - [0.1, 0.2, 0.3]
    assert np.abs(offset @ normal).max() < voxel  # flat: no thicker than the voxels themselves
    radius = 0.05 * np.sqrt(2 * np.log(0.9 / 0.3))
    reached = np.linalg.norm(offset, axis=1).max()
    assert radius - 2 * voxel < reached < radius + voxel
    # every point of the disc lies near a point of the cloud
    generator = np.random.default_rng(0)
    inside = generator.normal(size=(2000, 3))
    inside -= (inside @ normal)[:, None] * normal
    inside *= (radius * 0.97 * generator.random(2000) / np.linalg.norm(inside, axis=1))[:, None]
    nearest = np.linalg.norm(inside[:, None] - offset[None], axis=2).min(1)
    assert nearest.max() < voxel


def test_colours_are_weighted_by_opacity_and_the_heaviest_object_wins() -> None:
    gaussians = one([0.001, 0, 0], [1e-4] * 3, 0.9, [1.0, 0.0, 0.0], label=4)
    add(gaussians, [-0.001, 0, 0], [1e-4] * 3, 0.5, [0.0, 0.0, 1.0], label=7)
    add(gaussians, [0.002, 0, 0], [1e-4] * 3, 0.5, [0.0, 0.0, 1.0], label=7)
    cloud = sample_points(gaussians, 0.01, with_object_id=True)
    assert cloud.colors.tolist() == [[round(255 * 0.9 / 1.9), 0, round(255 * 1.0 / 1.9)]]
    assert cloud.object_id is not None and cloud.object_id.tolist() == [7]


def random_map(count: int = 400) -> GaussianMap:
    generator = torch.Generator().manual_seed(3)
    out = GaussianMap()
    out.insert(
        torch.rand(count, 3, generator=generator) * 2 - 1, torch.randn(count, 4, generator=generator),
        torch.log(torch.rand(count, 3, generator=generator) * 0.04 + 1e-3), torch.randn(count, generator=generator) * 2,
        torch.rand(count, 3, generator=generator), object_id=torch.randint(0, 5, (count,), generator=generator),
    )  # fmt: skip
    return out


def test_both_files_hold_the_same_points_and_are_read_back(tmp_path: Path) -> None:
    cloud = sample_points(random_map(), 0.01, with_object_id=True)
    assert len(np.unique(cloud.grid, axis=0)) == len(cloud) > 1000 and cloud.grid.min(0).tolist() == [0, 0, 0]
    write_points(tmp_path, cloud)
    metric, grid = read_ply(tmp_path / "points.ply"), read_ply(tmp_path / "points_grid.ply")
    assert metric.elements["vertex"]["x"].dtype == grid.elements["vertex"]["x"].dtype == np.float32
    np.testing.assert_allclose(metric.elements["vertex"]["y"], cloud.points[:, 1], atol=1e-6)
    for name in ("points.ply", "points_grid.ply"):
        found = read_points(tmp_path / name)
        np.testing.assert_array_equal(found.grid, cloud.grid)
        np.testing.assert_array_equal(found.colors, cloud.colors)
        np.testing.assert_array_equal(found.object_id, cloud.object_id)
        np.testing.assert_array_equal(found.points, cloud.points)


@pytest.mark.parametrize(("size", "voxel"), [(0.01, 0.01), (0.05, 0.02), (0.2, 0.06)])
def test_voxels_go_with_large_gaussians(size: float, voxel: float) -> None:
    """A room's are sampled in voxels of 1 cm; of a room five times as large there would be 25 times as many points."""
    gaussians, generator = GaussianMap(), np.random.default_rng(0)
    for mean in generator.random((20, 3)) * 100 * size:
        add(gaussians, mean.tolist(), [size, size, 1e-4], 0.9, [0.5, 0.5, 0.5])
    clouds = list(sample_parts([MapPart.of(gaussians)]))
    assert len({cloud.voxel_size for cloud in clouds}) == 1 and clouds[0].voxel_size == pytest.approx(voxel)
    assert sum(map(len, clouds)) < 20 * 250


def test_parts_with_a_gaussian_of_a_kilometre_are_those_of_the_whole_map() -> None:
    """Where it reaches to is not told in cubes: they would take gigabytes."""
    sizes = (10.0, 10.0, 1000.0, 10.0)
    parts = [one([1000.0 * i, 0, 0], [size, size, 1e-3], 0.9, [0.5] * 3) for i, size in enumerate(sizes)]
    whole = GaussianMap()
    for i, size in enumerate(sizes):
        add(whole, [1000.0 * i, 0, 0], [size, size, 1e-3], 0.9, [0.5] * 3)
    clouds = list(sample_parts([MapPart.of(part) for part in parts], voxel_size=20.0))
    found = np.concatenate([cloud.points for cloud in clouds])
    expected = sample_points(whole, 20.0).points
    assert len(found) == len(expected) > 1000
    assert {tuple(p) for p in np.rint(found / 20).tolist()} == {tuple(p) for p in np.rint(expected / 20).tolist()}


def test_the_size_of_the_chunks_does_not_matter() -> None:
    whole = sample_points(random_map(), 0.02, with_object_id=True)
    with overridden(PointSamplingTuning, samples_at_once=500):
        parts = sample_points(random_map(), 0.02, with_object_id=True)
        np.testing.assert_array_equal(parts.grid, whole.grid)
        np.testing.assert_array_equal(parts.object_id, whole.object_id)
        assert np.abs(parts.colors.astype(int) - whole.colors).max() <= 1


def test_impossible_requests_and_foreign_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="voxel size"):
        sample_points(random_map(), 0)
    with pytest.raises(ValueError, match="spans more"):
        sample_points(one([1e5, 0, 0], [1e-3] * 3, 0.9, [0, 0, 0]), 0.01)
    write_ply(tmp_path / "a.ply", {"vertex": np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4")])})
    with pytest.raises(FormatError, match=r"a\.ply.*red"):
        read_points(tmp_path / "a.ply")
    fields = [(n, "f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
    write_ply(tmp_path / "a.ply", {"vertex": np.zeros(3, fields)}, ["voxel_size zero"])
    with pytest.raises(FormatError, match="voxel_size"):
        read_points(tmp_path / "a.ply")
