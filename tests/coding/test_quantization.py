# SPDX-License-Identifier: Apache-2.0
"""Positions in metres come back in metres."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.coding import CodecSettings, decode_cloud, encode_cloud
from ggslam.coding.container import UnitType, unit_bytes
from ggslam.coding.quantization import Quantization, QuantizationTuning, choose_quantization
from ggslam.coding.stream import read_stream
from ggslam.coding.user_data import write_user_data
from ggslam.errors import ConfigError, FormatError


@pytest.fixture
def metres() -> np.ndarray:
    return np.random.default_rng(0).uniform((-3, 1, -0.5), (2, 1.5, 4), (500, 3))


def test_the_equation() -> None:
    """p~ = clip(round(s p) - o, 0, size - 1)."""
    q = Quantization(10.0, (-5, 0, 2), (4, 100, 100))
    points = np.array([[-0.46, 0.94, 0.34], [0.19, 0.0, 12.0], [-9.0, 0.96, 0.16]])
    assert q.apply(points).tolist() == [[0, 9, 1], [3, 0, 99], [0, 10, 0]]


@pytest.mark.parametrize("place", [(1.5, 2.25, -3.1), (463000.25, 5427000.5, 300.0)])
def test_points_all_at_one_place_stay_there(place: tuple[float, ...]) -> None:
    points = np.tile(place, (3, 1))
    decoded = decode_cloud(encode_cloud(points, settings=CodecSettings(duplicates="keep")).data)
    assert np.abs(decoded.points - points).max() < 1e-5


@pytest.mark.parametrize("bits", [4, 10, 16, 21])
def test_error_is_half_a_voxel_at_most(metres: np.ndarray, bits: int) -> None:
    coded = encode_cloud(metres, settings=CodecSettings(geometry_bits=bits, duplicates="keep"), reconstruct=True)
    cloud = decode_cloud(coded.data)
    assert coded.reconstruction is not None and np.array_equal(cloud.points, coded.reconstruction.points)
    edge = 1 / cloud.quantization.scale
    assert np.ptp(metres, 0).max() / edge == pytest.approx(2**bits - 1)
    for axis in range(3):
        error = np.abs(np.sort(cloud.points[:, axis]) - np.sort(metres[:, axis]))
        assert error.max() <= edge * (0.5 + QuantizationTuning.rounding + 1e-6)
    assert cloud.quantization.metres


def test_the_exact_scale_travels(metres: np.ndarray) -> None:
    """One that is no quotient of two 32-bit numbers."""
    settings = CodecSettings(voxel_size=np.pi / 300)
    cloud = decode_cloud(encode_cloud(metres, settings=settings).data)
    assert cloud.quantization.scale == 1 / (np.pi / 300)


def test_standard_fields_are_close_without_user_data(metres: np.ndarray) -> None:
    """What another decoder makes of the sequence parameter set."""
    data = encode_cloud(metres, settings=CodecSettings(voxel_size=np.pi / 300)).data
    sequence = read_stream(data).sequence
    assert float(sequence.resolution) == pytest.approx(300 / np.pi, rel=1e-9)
    assert sequence.offset == tuple(np.rint(metres.min(0) / (np.pi / 300)).astype(int))
    assert sequence.metres


def test_integers_come_back_as_they_are() -> None:
    points = np.array([[-7, 3, 2_000_000], [0, 4, 2_000_100]])
    cloud = decode_cloud(encode_cloud(points).data)
    assert sorted(cloud.points.tolist()) == sorted(points.tolist())
    assert cloud.grid_points.dtype == np.int32 and cloud.grid_points.min() == 0


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int16, np.int64])
def test_integers_of_any_kind(kind: type) -> None:
    points = np.array([[250, 3, 9], [251, 0, 200], [250, 3, 10]]).astype(kind)
    points = np.abs(points) if np.issubdtype(kind, np.signedinteger) else points
    cloud = decode_cloud(encode_cloud(points).data)
    assert sorted(cloud.points.tolist()) == sorted(points.astype(float).tolist())


def test_half_resolution() -> None:
    points = np.stack(np.meshgrid(*[np.arange(9)] * 3), -1).reshape(-1, 3)
    cloud = decode_cloud(encode_cloud(points, settings=CodecSettings(geometry_scale=0.5)).data)
    assert len(cloud) == 125
    assert np.array_equal(np.unique(cloud.points), [0, 2, 4, 6, 8])  # whole numbers, as every decoder has them


def test_a_box_clips(metres: np.ndarray) -> None:
    settings = CodecSettings(box=((-1, 1, 0), (1, 1.25, 1)), voxel_size=0.125, duplicates="keep")
    cloud = decode_cloud(encode_cloud(metres, settings=settings).data)
    assert len(cloud) == len(metres)
    assert np.array_equal(cloud.grid_points.max(0), [16, 2, 8])
    assert cloud.quantization.size == (17, 3, 9)


def test_grids_of_more_than_21_bits_are_refused(metres: np.ndarray) -> None:
    with pytest.raises(ConfigError, match="choose larger voxels"):
        encode_cloud(metres, settings=CodecSettings(voxel_size=1e-6))
    with pytest.raises(ConfigError, match="too small"):
        choose_quantization(metres * 1e9, 1e-9, 10, 1.0, None)


def test_positions_must_be_numbers() -> None:
    with pytest.raises(FormatError, match="not finite"):
        encode_cloud(np.array([[0.0, np.nan, 1.0]]))
    with pytest.raises(FormatError, match="without points"):
        encode_cloud(np.empty((0, 3)))
    with pytest.raises(ConfigError, match=r"expected \[N, 3\]"):
        encode_cloud(np.zeros((4, 2)))


def test_points_that_were_on_a_grid_stay_apart() -> None:
    """However their coordinates were rounded: k * 0.01 may lie just below the face between two voxels."""
    grid = np.unique(np.random.default_rng(0).integers(-300, 500, (4000, 3)), axis=0)
    for kind in (np.float32, np.float64):
        points = (grid * 0.01).astype(kind)
        coded = encode_cloud(points, None, CodecSettings(voxel_size=0.01))
        assert coded.report.points == len(grid)


@pytest.mark.parametrize("far", [1.7e308, 1e200])
def test_impossible_spans_are_refused(far: float) -> None:
    with pytest.raises(ConfigError, match="voxel"):
        encode_cloud(np.array([[-far, 0, 0], [far, 0, 0]]))
    assert encode_cloud(np.array([[5e-324, 0, 0], [0, 0, 0]])).report.points == 1


def test_settings_are_whole_numbers_and_boxes_have_insides() -> None:
    for wrong in ({"qp": 22.5}, {"slices": 1.5}, {"box": ((0, 0, 0), (1, -1, 1))}, {"box": 1}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            CodecSettings(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("scale", [1 / 2, 3 / 4, 15 / 16, 1 / 3, 0.3, 2.0])
def test_integers_go_to_the_nearest_voxel(scale: float) -> None:
    """At most half a voxel away, along each axis; where a voxel is a whole number of them, they are integers again."""
    integers = np.arange(480).reshape(-1, 1).repeat(3, 1)
    grid = choose_quantization(integers, None, 10, scale, None)
    found = grid.restore(grid.apply(integers))
    assert np.abs(found - integers).max() <= 0.5 / scale + 1e-9 and grid.centre == 0
    if (1 / scale).is_integer():
        assert np.array_equal(found, np.rint(found))


@pytest.mark.parametrize("size", [1.0, 0.01, np.pi / 300])
def test_points_on_the_grid_come_back_as_they_are(size: float) -> None:
    """A coordinate of the grid denotes the centre of its voxel: nothing lies half a voxel off."""
    whole = np.random.default_rng(3).integers(-300, 300, (400, 3))
    for points in (whole * size, (whole * size).astype(np.float32)):
        cloud = decode_cloud(encode_cloud(points, settings=CodecSettings(voxel_size=size)).data)
        found, wanted = np.unique(cloud.points, axis=0), np.unique(whole, axis=0) * size
        assert found.shape == wanted.shape and np.abs(found - wanted).max() < 1e-9
        sequence = read_stream(encode_cloud(points, settings=CodecSettings(voxel_size=size)).data).sequence
        standard = (cloud.grid_points + np.array(sequence.offset)) / float(sequence.resolution)
        assert np.abs(standard - cloud.points).max() < 1e-6 * size  # as decoders have it that know the standard alone


def test_streams_of_earlier_versions_are_restored_as_they_were() -> None:
    """Their coordinates denoted a voxel's lowest corner, and the user data told where in it the point lay."""
    data = encode_cloud(np.array([[1.0, 2, 3]]), settings=CodecSettings(voxel_size=0.5)).data
    old = data + unit_bytes(UnitType.USER_DATA, write_user_data({"centre": 0.5}))
    assert decode_cloud(data).points.tolist() == [[1, 2, 3]]
    assert decode_cloud(old).points.tolist() == [[1.25, 2.25, 3.25]]


def test_the_mean_of_metric_points_does_not_move(metres: np.ndarray) -> None:
    cloud = decode_cloud(encode_cloud(metres, settings=CodecSettings(voxel_size=0.05, duplicates="keep")).data)
    assert np.abs(cloud.points.mean(0) - metres.mean(0)).max() < 0.05 / np.sqrt(12) / np.sqrt(len(metres)) * 4
