# SPDX-License-Identifier: Apache-2.0
"""Geometry tools of sparse clouds: planes and levels that split some axes only, chosen where they pay."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.coding import CodecSettings, decode_cloud, encode_cloud
from ggslam.coding.geometry_syntax import GeometryHeader, GeometryParameters
from ggslam.coding.geometry_tools import levels_of, split_axes
from ggslam.coding.slice_coder import SliceCoder
from ggslam.coding.stream import read_stream


def scan(count: int = 12_000) -> np.ndarray:
    """What a spinning scanner sees of a street: ground and two walls, voxels of 5 mm, unique."""
    rng = np.random.default_rng(0)
    angle, ring = rng.uniform(0, 2 * np.pi, count), rng.integers(1, 33, count)
    distance = np.minimum(1.8 / np.tan(0.012 * ring), 8 / np.abs(np.sin(angle)))
    height = np.where(distance < 1.8 / np.tan(0.012 * ring), 1.8 - distance * np.tan(0.012 * ring), 0.0)
    metres = np.stack([distance * np.cos(angle), distance * np.sin(angle), height], 1)
    grid = np.floor((metres + rng.normal(0, 0.004, (count, 3))) / 0.005).astype(np.int64)
    return np.unique(grid - grid.min(0), axis=0)


def test_long_sides_are_split_first() -> None:
    assert split_axes((3, 3, 1)) == (6, 6, 7) and split_axes((1, 2, 3)) == (1, 3, 7)
    assert split_axes((0, 0, 0)) == (4,)
    assert levels_of(GeometryParameters(), (3, 5, 1)) == (7,) * 5


@pytest.mark.parametrize("boundary", [0, 3, 8])
@pytest.mark.parametrize("unique", [True, False])
def test_trees_with_planes_come_back(boundary: int, unique: bool) -> None:
    points = scan(3000)
    if not unique:
        points = np.repeat(points, 1 + np.arange(len(points)) % 3, axis=0)
    tools = GeometryParameters(unique, boundary, boundary > 0, 6 if boundary else 0, partial_splits=True, planes=True,
                               plane_thresholds=(60, 80, 100))  # fmt: skip
    bits = [int(side).bit_length() for side in points.max(0)]
    axes = split_axes(bits)
    coder = SliceCoder()
    coder.build(points, max(bits))
    payload = coder.encode_geometry(tools, axes)
    found = SliceCoder().decode_geometry(tools, GeometryHeader(0, (0, 0, 0), axes, len(points)), payload)
    assert np.array_equal(found[np.lexsort(found.T)], points[np.lexsort(points.T)])


def test_planes_are_used_where_they_pay(surface: tuple[np.ndarray, np.ndarray]) -> None:
    points = scan()
    sizes = {}
    for planes in (False, None, True):
        encoded = encode_cloud(points, {}, CodecSettings(planes=planes, slices=3))
        decoded = decode_cloud(encoded.data).points
        assert np.array_equal(decoded[np.lexsort(decoded.T)], points[np.lexsort(points.T)])
        sizes[planes] = encoded.report.geometry_bytes
    assert sizes[None] == sizes[True] < 0.95 * sizes[False]
    dense = encode_cloud(surface[0], {}, CodecSettings())
    assert not read_stream(dense.data).slices[0].geometry.planes


def test_slices_of_differing_density_share_one_parameter_set() -> None:
    rng = np.random.default_rng(0)
    dense = np.stack(np.meshgrid(*[np.arange(20)] * 3, indexing="ij"), -1).reshape(-1, 3)
    points = np.concatenate([dense, [500, 0, 0] + rng.integers(0, 400, (8000, 3))])
    for duplicates in ("merge", "keep"):
        stream = read_stream(encode_cloud(points, {}, CodecSettings(slices=4, duplicates=duplicates)).data)
        assert len({id(units.geometry) for units in stream.slices}) == 1 and len(stream.slices) == 4
