# SPDX-License-Identifier: Apache-2.0
"""The search for nearest neighbours on a device finds what a tree finds."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from ggslam.cuda.library import CudaLibrary
from ggslam.errors import RenderError
from ggslam.mapping.cuda.neighbours import cuda_neighbours


def search(library: CudaLibrary, points: np.ndarray, rows: np.ndarray, k: int) -> np.ndarray:
    device = library.whole_device(None)
    found = cuda_neighbours(torch.from_numpy(points).to(device), torch.from_numpy(rows).to(device), k, library)
    assert found.dtype == torch.int64 and found.device == device
    return found.cpu().numpy()


def distances_to(points: np.ndarray, rows: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[neighbours].astype(float) - points[rows][:, None], axis=2)


def check_nearest(points: np.ndarray, rows: np.ndarray, found: np.ndarray) -> None:
    """Right up to the choice among equally near points."""
    k = found.shape[1]
    expected, _ = cKDTree(points).query(points[rows], k + 1)
    np.testing.assert_allclose(distances_to(points, rows, found), expected[:, 1:], rtol=1e-6, atol=1e-9)
    assert (found != rows[:, None]).all() and found.min() >= 0 and found.max() < len(points)
    assert all(len(set(row)) == k for row in found.tolist())


def random_points(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)


@pytest.mark.parametrize(("points", "rows"), [(2, 2), (31, 5), (33, 17), (1024, 16), (1025, 1), (9000, 20)])
@pytest.mark.parametrize("k", [1, 5, 32, 40])
def test_same_distances_as_a_tree(cuda_library: CudaLibrary, points: int, rows: int, k: int) -> None:
    cloud = random_points(points)
    chosen = np.random.default_rng(1).choice(points, rows, replace=False)
    found = search(cuda_library, cloud, chosen, k)
    assert found.shape == (rows, min(k, points - 1))
    check_nearest(cloud, chosen, found)


@pytest.mark.parametrize("k", [5, 40])
def test_points_at_the_same_place_are_neighbours_of_each_other(cuda_library: CudaLibrary, k: int) -> None:
    cloud = np.repeat(random_points(700), 3, axis=0)
    rows = np.arange(0, 2100, 97)
    found = search(cuda_library, cloud, rows, k)
    check_nearest(cloud, rows, found)
    twins = rows[:, None] // 3 * 3 + np.arange(3)
    assert all({*t} - {r} == {*f[:2]} for t, r, f in zip(twins.tolist(), rows.tolist(), found.tolist(), strict=True))


def test_among_equally_near_points_the_lowest_numbers_are_taken(cuda_library: CudaLibrary) -> None:
    cloud = np.zeros((5000, 3), np.float32)
    cloud[100:] = np.eye(3, dtype=np.float32)[np.arange(4900) % 3]
    cloud[[60, 1500, 4000]] = 7.0
    found = search(cuda_library, cloud, np.array([50, 4999, 2, 4000]), 7)
    np.testing.assert_array_equal(found[0], np.arange(7))
    np.testing.assert_array_equal(found[3, :2], [60, 1500])
    np.testing.assert_array_equal(found[2], [0, 1, 3, 4, 5, 6, 7])
    np.testing.assert_array_equal(found[1], 100 + np.arange(7) * 3 + (4999 - 100) % 3)


@pytest.mark.parametrize("k", [5, 35])
def test_points_that_are_not_finite_are_nobodys_neighbours(cuda_library: CudaLibrary, k: int) -> None:
    cloud = random_points(300)
    cloud[::2, 1], cloud[10, 0] = np.nan, np.inf
    rows = np.array([1, 10, 51, 299])
    found = search(cuda_library, cloud, rows, k)
    good = [0, 2, 3]
    finite = np.flatnonzero(np.isfinite(cloud).all(1))
    place = np.searchsorted(finite, rows[good])
    check_nearest(cloud[finite], place, np.searchsorted(finite, found[good]))
    assert np.isin(found[good], finite).all()
    assert (found[1] == 10).all()  # it has none


@pytest.mark.parametrize("k", [6, 34])
def test_a_row_with_too_few_others_names_itself(cuda_library: CudaLibrary, k: int) -> None:
    cloud = random_points(50)
    cloud[4:] = np.nan
    found = search(cuda_library, cloud, np.array([2]), k)
    assert set(found[0, :3]) == {0, 1, 3} and (found[0, 3:] == 2).all() and found.shape == (1, k)


def test_tiny_maps_and_no_rows(cuda_library: CudaLibrary) -> None:
    assert search(cuda_library, random_points(1), np.array([0, 0]), 5).shape == (2, 0)
    assert search(cuda_library, random_points(0), np.zeros(0, np.int64), 5).shape == (0, 0)
    assert search(cuda_library, random_points(9), np.zeros(0, np.int64), 5).shape == (0, 5)
    assert search(cuda_library, random_points(9), np.array([3]), 0).shape == (1, 0)
    found = search(cuda_library, random_points(2), np.array([0, 1, 0], np.int32), 3)
    np.testing.assert_array_equal(found, [[1], [0], [1]])


def test_with_many_rows_a_part_has_several_tiles(cuda_library: CudaLibrary) -> None:
    """Two parts, one of two tiles and one of one."""
    cloud, rows = random_points(2100), np.tile(np.arange(2100), 2)[:2830]
    found = search(cuda_library, cloud, rows, 2)
    check_nearest(cloud, rows[:2100], found[:2100])
    np.testing.assert_array_equal(found[2100:], found[:730])


@pytest.mark.usefixtures("other_order")
@pytest.mark.parametrize("cuda_library", ["emulated"], indirect=True)
def test_the_order_of_threads_does_not_matter(cuda_library: CudaLibrary) -> None:
    cloud, rows = random_points(3000), np.arange(0, 3000, 150)
    check_nearest(cloud, rows, search(cuda_library, cloud, rows, 8))


def test_wrong_arrays_are_refused(cuda_library: CudaLibrary) -> None:
    device = cuda_library.whole_device(None)
    points, rows = torch.zeros(9, 3, device=device), torch.zeros(2, dtype=torch.int64, device=device)
    with pytest.raises(RenderError, match="points: .*torch.float32"):
        cuda_neighbours(points.double(), rows, 2, cuda_library)
    with pytest.raises(RenderError, match="contiguous"):
        cuda_neighbours(torch.zeros(3, 9, device=device).T, rows, 2, cuda_library)
    with pytest.raises(RenderError, match="rows"):
        cuda_neighbours(points, rows.float(), 2, cuda_library)
