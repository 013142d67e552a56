# SPDX-License-Identifier: Apache-2.0
"""Rows of a map that come and go on a device are those of the map's own operations, bit for bit."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from ggslam.cuda.library import CudaLibrary
from ggslam.mapping.cuda.map_rows import MapRows
from ggslam.mapping.pruning import prune
from ggslam.mapping.settings import PruningSettings
from ggslam.scene.gaussian_map import GaussianMap


def make_map(device: torch.device, count: int = 3000, degree: int = 1) -> GaussianMap:
    """All arrays of it are full of numbers."""
    rng = np.random.default_rng(count)
    gaussians = GaussianMap(degree, 5, device)
    gaussians.extend(count)
    for array in gaussians.storage.values():
        values = rng.normal(size=array.shape) if array.dtype == torch.float32 else rng.integers(-5, 5, array.shape)
        array.copy_(torch.from_numpy(values.astype(np.float32 if array.dtype == torch.float32 else np.int32)))
    return gaussians


def assert_same(found: GaussianMap, expected: GaussianMap) -> None:
    ours, theirs = found.state(), expected.state()
    assert {name: ours[name] for name in ("count", "version", "order")} == {
        name: theirs[name] for name in ("count", "version", "order")
    }
    for name, rows in theirs["rows"].items():
        assert torch.equal(ours["rows"][name].cpu(), rows), name


@pytest.mark.parametrize("count", [1, 300, 70_000])
def test_rows_that_stay_keep_their_order(cuda_library: CudaLibrary, count: int) -> None:
    """More of them than are moved at a time, too."""
    device = cuda_library.whole_device(None)
    found, expected = make_map(device, count), make_map(torch.device("cpu"), count)
    rows = MapRows(device, cuda_library)
    stays = torch.from_numpy(np.random.default_rng(1).random(count) < 0.98)
    stays[0] = True
    assert rows.keep(found, torch.ones(count, dtype=torch.bool, device=device)) == 0
    assert rows.keep(found, stays.to(device)) == expected.keep(stays) == count - int(stays.sum())
    assert_same(found, expected)
    none = torch.zeros(len(found), dtype=torch.bool)
    assert rows.keep(found, none.to(device)) == expected.keep(none) > 0
    assert rows.keep(found, none.to(device)) == 0
    assert_same(found, expected)


def test_the_same_gaussians_are_pruned(cuda_library: CudaLibrary) -> None:
    device, settings = cuda_library.whole_device(None), PruningSettings()
    found, expected = make_map(device), make_map(torch.device("cpu"))
    for gaussians in (found, expected):
        gaussians.log_scales.sub_(2.0)
        gaussians.means[7, 1], gaussians.means[8, 0] = math.nan, math.inf
        gaussians.log_scales[9, 2], gaussians.opacity_logits[10] = math.nan, math.nan
    gone = prune(expected, settings)
    assert MapRows(device, cuda_library).prune(found, settings) == gone and 100 < gone < 2900
    assert_same(found, expected)


@pytest.mark.parametrize("degree", [0, 2])
def test_new_rows_begin_as_inserted_ones(cuda_library: CudaLibrary, degree: int) -> None:
    """In the place of rows that were there, and where the map has to grow."""
    device = cuda_library.whole_device(None)
    found, expected = make_map(device, 500, degree), make_map(torch.device("cpu"), 500, degree)
    rows = MapRows(device, cuda_library)
    few = torch.arange(500) < 100
    rows.keep(found, few.to(device))
    expected.keep(few)
    for added in (200, 30_000):
        at = rows.append(found, added, 0.25, 3)
        means, quaternions, log_scales, rgb = (torch.rand(added, n) for n in (3, 4, 3, 3))
        assert at == expected.insert(means, quaternions, log_scales, 0.25, rgb, birth_keyframe=3)
        for name in ("means", "quaternions", "log_scales"):
            getattr(found, name)[at] = getattr(expected, name)[at].to(device)
        found.sh[at, 0] = expected.sh[at, 0].to(device)
        assert_same(found, expected)
