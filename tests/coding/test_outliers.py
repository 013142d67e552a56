# SPDX-License-Identifier: Apache-2.0
"""A few points far away leave the others their precision: measured in millimetres."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from ggslam.coding import CodecSettings
from ggslam.coding.outliers import bulk_of, reach_of
from ggslam.formats.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from ggslam.formats.point_cloud import read_point_cloud, write_point_cloud
from ggslam.jobs.encode.coding import decode_file, encode_file
from ggslam.scene.gaussian_map import GaussianMap


def room(count: int = 3000) -> np.ndarray:
    """Points of a room 5 m wide, metres."""
    return np.random.default_rng(1).uniform((-2, -1, 0), (3, 1.5, 4), (count, 3))


def off(found: np.ndarray, points: np.ndarray) -> float:
    """Farthest of `points` from those found, along an axis, metres."""
    _, nearest = cKDTree(found).query(points)
    return float(np.abs(found[nearest] - points).max())


@pytest.mark.parametrize(("far", "said"), [(40.0, "1 point lies far"), (5e3, "1 point lies far"), (1e5, "left out 1")])
@pytest.mark.parametrize("count", [300, 20_000])
def test_points_keep_their_precision(tmp_path: Path, far: float, said: str, count: int) -> None:
    points = room(count)
    alone, path = points.copy(), tmp_path / "a.ply"
    points = np.concatenate([points, [[0.5, far, 1]]])
    write_point_cloud(path, points, {"object_id": np.arange(len(points)) % 7})
    done = encode_file(path, tmp_path / "a.bin", CodecSettings(geometry_bits=10))
    decode_file(tmp_path / "a.bin", tmp_path / "b.ply")
    assert any(said in note for note in done.notes), done.notes
    found = read_point_cloud(tmp_path / "b.ply").points
    voxel = 5.0 / (1 << 10)  # 4.9 mm
    assert off(found, alone) < 0.52 * voxel
    reached = said.startswith("1")
    assert (off(found, points[-1:]) < 0.52 * voxel) == reached
    assert done.report.input_points == len(points) - (not reached)


def test_a_cloud_without_outliers_is_coded_as_ever() -> None:
    points = room()
    settings = CodecSettings(geometry_bits=12)
    for parts in ([points], [points * [1, 30, 1]], [np.concatenate([points, points + 8])], [points[:9]], []):
        reach = reach_of(parts, settings, sum(map(len, parts)))
        assert reach.settings == settings and reach.keep(points) == slice(None) and not reach.notes("point")


def test_the_bulk_passes_over_a_few() -> None:
    points = np.concatenate([room(1000), np.full((4, 3), 1e6), np.full((2, 3), -1e6)])
    assert (bulk_of(points)[0] > [-2, -1, 0]).all() and (bulk_of(points)[1] < [3, 1.5, 4]).all()
    assert np.array_equal(bulk_of(points[:10]), [points[:10].min(0), points[:10].max(0)])


def test_a_named_voxel_size_stays_and_what_it_cannot_reach_is_left_out(tmp_path: Path) -> None:
    points = np.concatenate([room(), [[0, 0, 1e5]]])
    for cloud, voxel in ((points, 0.001), (np.rint(points * 1000).astype(np.int32), None)):
        write_point_cloud(tmp_path / "a.ply", cloud, {})
        done = encode_file(tmp_path / "a.ply", tmp_path / "a.bin", CodecSettings(voxel_size=voxel))
        assert "left out 1 point far outside" in " ".join(done.notes)
        decode_file(tmp_path / "a.bin", tmp_path / "b.ply")
        found = read_point_cloud(tmp_path / "b.ply").points
        assert off(found, cloud[:-1]) < (0.00051 if voxel else 1e-9)


@pytest.mark.parametrize(("far", "said"), [(100.0, "1 Gaussian lies far"), (5e3, "left out 1"), (1e5, "left out 1")])
def test_gaussians_keep_their_precision(tmp_path: Path, far: float, said: str) -> None:
    means = np.concatenate([room(), [[far, 0, 2]]])
    gaussians = GaussianMap(0, with_moments=False)
    n = len(means)
    gaussians.insert(
        torch.tensor(means, dtype=torch.float32), torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.full((n, 3), -4.0), torch.ones(n), torch.full((n, 3), 0.5),
    )  # fmt: skip
    write_gaussian_ply(tmp_path / "map.ply", gaussians)
    done = encode_file(tmp_path / "map.ply", tmp_path / "a.bin", CodecSettings(), "splat", "r04")
    assert any(said in note for note in done.notes), done.notes
    decode_file(tmp_path / "a.bin", tmp_path / "b.ply")
    found = read_gaussian_ply(tmp_path / "b.ply").means.numpy()
    assert off(found, means[:-1].astype(np.float32)) < 0.51 * np.exp(-4) / 64  # 0.15 mm
    assert len(found) == n - said.startswith("left")
