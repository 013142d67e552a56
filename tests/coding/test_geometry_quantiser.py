# SPDX-License-Identifier: Apache-2.0
"""Positions that are quantised within the octree: their error, the stream as a slow decoder reads it, other encoders'
streams with a quantiser a node."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gpcc_reference import SiblingTreeDecoder

from ggslam.coding import CodecSettings, decode_cloud, encode_cloud
from ggslam.coding.block_encoder import encode_blocks
from ggslam.coding.geometry_syntax import GeometryHeader, GeometryParameters
from ggslam.coding.position_quantiser import PositionQuantiser
from ggslam.coding.slice_coder import SliceCoder
from ggslam.coding.stream import read_stream
from ggslam.errors import ConfigError

Surface = tuple[np.ndarray, np.ndarray]
QPS = (1, 3, 7, 8, 11, 16, 21, 24, 40, 60)


def decoded_places(points: np.ndarray, settings: CodecSettings) -> np.ndarray:
    """Where each point is after decoding."""
    numbers = np.arange(len(points))
    data = encode_cloud(points, {"object_id": numbers}, replace(settings, duplicates="keep")).data
    cloud = decode_cloud(data)
    return cloud.points[np.argsort(cloud.attributes["object_id"])]


def least_distances(points: np.ndarray, qp: int) -> np.ndarray:
    """Along each axis, from whole points to the nearest multiple of the step (counted from the lowest corner), rounded
    to voxels: in floating point, among all of them."""
    step, own = 2.0 ** (qp // 8) * (1 + qp % 8 / 8), points - points.min(0)
    places = np.floor(np.arange(own.max() // step + 3) * step + 0.5)
    nearest = np.abs(np.arange(own.max() + 1)[:, None] - places).min(1)
    return nearest[own]


@pytest.mark.parametrize("planes", [False, True])
@pytest.mark.parametrize("qp", QPS)
def test_positions_become_the_nearest_steps(surface: Surface, qp: int, planes: bool) -> None:
    points, colors = surface
    points = points + np.array([1000, 3, 77], np.int32)
    quantiser = PositionQuantiser(qp)
    cloud = decode_cloud(encode_cloud(points, {"color": colors}, CodecSettings(geometry_qp=qp, planes=planes)).data)
    places = decoded_places(points, CodecSettings(geometry_qp=qp, planes=planes))
    assert np.array_equal(np.abs(places - points), least_distances(points, qp))
    assert np.abs(places - points).max() <= quantiser.reach == np.ceil(quantiser.step / 2)
    assert np.array_equal(np.unique(cloud.points, axis=0), np.unique(places, axis=0))
    assert len(np.unique(cloud.points, axis=0)) == len(cloud)  # points that fell together are one


@pytest.mark.parametrize("high", [126, 127, 128, 255, 256])
def test_no_point_is_rounded_down_at_the_end_of_the_tree(high: int) -> None:
    points = np.array([[0, 0, 0], [high, 0, 0]])
    places = decoded_places(points, CodecSettings(geometry_qp=21))
    assert np.array_equal(np.abs(places - points), least_distances(points, 21))
    assert abs(places[1, 0] - high) <= PositionQuantiser(21).step / 2


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("qp", [1, 4, 8, 12, 16, 20, 24])
def test_the_cloud_is_not_shifted(qp: int, whole: bool) -> None:
    """And a point moves no farther than on a grid that is coarser by the same step."""
    points = np.random.default_rng(0).random((20_000, 3)) * 3
    voxel = 1.0 if whole else 0.01
    if whole:
        points = np.rint(points / 0.01).astype(np.int32)
    fine = CodecSettings(voxel_size=voxel, geometry_qp=qp)
    coarse = CodecSettings(voxel_size=voxel, geometry_scale=1 / PositionQuantiser(qp).step)
    moved, on_coarse = ((decoded_places(points, settings) - points) / voxel for settings in (fine, coarse))
    assert np.abs(moved.mean(0)).max() < 0.1
    if qp % 8 == 0:  # else decoded points are rounded to voxels once more
        assert np.linalg.norm(moved, axis=1).mean() < 1.001 * np.linalg.norm(on_coarse, axis=1).mean()


def test_points_of_a_plane_stay_in_a_plane() -> None:
    """Also where they are no whole voxels, but for rounding errors."""
    points = np.random.default_rng(0).random((3000, 3)).astype(np.float32)
    for height in range(9):
        points[:, 2] = np.float32(height * 0.01) + np.random.default_rng(1).uniform(-1e-6, 1e-6, 3000)
        points[0] = 0
        places = decoded_places(points, CodecSettings(voxel_size=0.01, geometry_qp=8))
        assert len(np.unique(np.rint(places[1:, 2] * 100))) == 1


def test_quantiser_0_is_without_loss(surface: Surface) -> None:
    points, colors = surface
    plain, told = (encode_cloud(points, {"color": colors}, s).data for s in (None, CodecSettings(geometry_qp=0)))
    assert plain == told
    sides, scaled = (7,) * 8, GeometryParameters(scaling=True)
    coder = SliceCoder()
    coder.build(points, 8)
    payload, header = coder.encode_geometry(scaled, sides), GeometryHeader(0, (0, 0, 0), sides, len(points))
    assert GeometryParameters.read(scaled.write()) == scaled
    assert np.array_equal(SliceCoder().decode_geometry(scaled, header, payload), coder.positions())


@pytest.mark.parametrize("qp", [0, 1, 5, 8, 13, 16, 27])
def test_a_slow_decoder_reads_the_same(surface: Surface, gpcc_data: Path, qp: int) -> None:
    points, _ = surface
    tables = json.loads((gpcc_data / "tables.json").read_text())
    settings = CodecSettings(geometry_qp=qp, neighbour_boundary=0, planes=False)
    data = encode_cloud(points[:3000], {}, settings).data
    units = read_stream(data).slices[0]
    assert units.geometry.scaling == (qp > 0) and units.geometry.base_qp == qp
    slow = SiblingTreeDecoder(bytes(units.payload), tables)
    found = slow.positions(units.header.depth, qp if qp else None) + units.header.origin
    assert np.array_equal(np.unique(found, axis=0), np.unique(decode_cloud(data).grid_points, axis=0))
    assert len(found) == units.header.points
    assert slow.qps == ([qp] if qp else [])


def test_colours_of_points_that_fall_together_are_their_mean() -> None:
    points = np.array([[0, 0, 0], [8, 8, 8], [9, 8, 8], [9, 9, 9]])
    grey = np.array([10, 100, 110, 150], np.uint8)[:, None].repeat(3, 1)
    cloud = decode_cloud(encode_cloud(points, {"color": grey}, CodecSettings(geometry_qp=16, qp=4)).data)
    assert cloud.points.tolist() == [[0, 0, 0], [8, 8, 8]]
    assert np.abs(cloud.attributes["color"][:, 0] - [10.0, 120]).max() <= 1
    kept = encode_cloud(points, {"color": grey}, CodecSettings(geometry_qp=16, qp=4, duplicates="keep")).data
    assert decode_cloud(kept).points.tolist() == [[0, 0, 0], [8, 8, 8], [8, 8, 8], [8, 8, 8]]


def test_slices_count_steps_from_their_own_corner_and_lie_in_the_box(surface: Surface, tmp_path: Path) -> None:
    points, colors = surface
    settings = CodecSettings(geometry_qp=28, slices=4)
    encoded = encode_cloud(points, {"color": colors}, settings, reconstruct=True)
    cloud, size = decode_cloud(encoded.data), read_stream(encoded.data).sequence.size
    assert encoded.reconstruction is not None and size is not None
    assert np.array_equal(encoded.reconstruction.grid_points, cloud.grid_points)
    assert (cloud.grid_points >= 0).all() and (cloud.grid_points < np.array(size)).all()
    moved = np.abs(points[:, None] - cloud.points[None]).max(2).min(1)
    assert PositionQuantiser(28).reach / 2 < moved.max() <= PositionQuantiser(28).reach
    encode_blocks(iter([(points, {"color": colors})]), settings, tmp_path / "blocks.bin")
    assert (tmp_path / "blocks.bin").read_bytes() == encoded.data


def test_coarser_steps_take_fewer_bytes(surface: Surface) -> None:
    sizes = [encode_cloud(surface[0], {}, CodecSettings(geometry_qp=qp)).report.geometry_bytes for qp in (0, 8, 16, 24)]
    assert sizes == sorted(sizes, reverse=True) and sizes[3] < sizes[0] / 10
    with pytest.raises(ConfigError, match="geometry_qp"):
        CodecSettings(geometry_qp=97)
