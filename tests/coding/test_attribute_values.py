# SPDX-License-Identifier: Apache-2.0
"""Colours, ids and other attributes on their way in and out."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.coding import AttributeSettings, CodecSettings, decode_cloud, encode_cloud
from ggslam.coding.attribute_values import IdTable
from ggslam.coding.container import UnitType, read_units, unit_bytes
from ggslam.coding.slice_coder import rgb_to_ycbcr, ycbcr_to_rgb
from ggslam.coding.stream import read_stream, read_table
from ggslam.errors import ConfigError, FormatError

IDS = {"id": AttributeSettings(lossless=True)}


def test_colours_follow_bt709() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (5000, 3)).astype(np.uint8)
    r, g, b = rgb.astype(np.float64).T
    y = 0.2126 * r + 0.7152 * g + 0.0722 * b
    expected = np.stack([y, (b - y) / 1.8556 + 128, (r - y) / 1.5748 + 128], 1)
    found = rgb_to_ycbcr(rgb, np.arange(5000, dtype=np.uint32))
    assert np.abs(found - expected.clip(0, 255)).max() < 0.51
    y, u, v = found.astype(np.float64).T
    back = np.stack([y + 1.5748 * (v - 128), y - 0.1873 * (u - 128) - 0.4681 * (v - 128), y + 1.8556 * (u - 128)], 1)
    assert np.abs(ycbcr_to_rgb(found) - back.clip(0, 255)).max() < 0.52
    assert np.abs(ycbcr_to_rgb(found).astype(int) - rgb).max() <= 2


def test_colours_are_rounded_as_the_reference_encoder_rounds_them() -> None:
    """Every luma that lies on a half, or a hair beside it, and all greys and corners: to the last bit of double."""
    r, g, b = (axis.ravel() for axis in np.meshgrid(*[np.arange(256)] * 3, indexing="ij"))
    ties = (2126 * r + 7152 * g + 722 * b) % 10000 == 5000
    chroma = np.abs((500000 * r - 454153 * g - 45847 * b) % 1000000 - 500000) < 20
    rgb = np.stack([r, g, b], 1)[ties | chroma | (r == g) & (g == b) | (r % 255 + g % 255 + b % 255 == 0)]
    r, g, b = rgb.astype(np.float64).T
    components = [0.2126 * r + 0.7152 * g + 0.0722 * b, -0.114572 * r - 0.385428 * g + 0.5 * b + 128.0,
                  0.5 * r - 0.454153 * g - 0.045847 * b + 128.0]  # fmt: skip
    expected = np.floor(np.stack(components, 1) + 0.5).clip(0, 255)
    found = rgb_to_ycbcr(rgb.astype(np.uint8), np.arange(len(rgb), dtype=np.uint32))
    assert len(rgb) > 3000
    np.testing.assert_array_equal(found, expected)


def test_identity_keeps_colours_apart(surface: tuple) -> None:
    """Components are G, B, R: the chroma offset reaches blue and red alone."""
    points, colors = surface
    settings = CodecSettings(qp=4, chroma_offset=30, attributes={"color": AttributeSettings(color_space="identity")})
    cloud = decode_cloud(encode_cloud(points, {"color": colors}, settings).data)
    true = {tuple(p): c for p, c in zip(points.tolist(), colors.astype(int), strict=True)}
    error = np.abs(cloud.attributes["color"] - np.array([true[tuple(p)] for p in cloud.points.tolist()]))
    assert error[:, 1].max() <= 1 and error[:, 0].mean() > 0.5 and error[:, 2].mean() > 0.5


@pytest.mark.parametrize("count", [1, 2, 20, 300, 3000, 65536])
def test_ids_come_back_exactly(count: int) -> None:
    """Also where the table is too large for the transform alone, and corrections are sent."""
    rng = np.random.default_rng(count)
    points = rng.permutation(np.stack(np.meshgrid(*[np.arange(41)] * 3), -1).reshape(-1, 3))
    ids = rng.integers(0, count, len(points)).astype(np.uint16)
    if count == 65536:
        ids[:count] = rng.permutation(count)
    coded = encode_cloud(points, {"id": ids}, CodecSettings(attributes=IDS, slices=2))
    cloud = decode_cloud(coded.data)
    true = np.zeros((41, 41, 41), np.uint16)
    true[tuple(points.T)] = ids
    assert np.array_equal(cloud.attributes["id"], true[tuple(cloud.points.astype(int).T)])
    corrected = sum(s.user_data_bytes for s in coded.report.slices)
    assert (corrected > 0) == (count > 300)


def test_every_decoder_sees_small_ids_and_the_ranks_of_others(surface: tuple) -> None:
    """By the attribute's scale in the sequence parameter set, without the table in the user data."""
    points = surface[0]
    for known, expected in (([0, 4, 200], [0, 4, 200]), ([9, 300, 65535], [0, 1, 2])):
        ids = np.array(known, np.uint16)[np.arange(len(points)) % 3]
        data = encode_cloud(points, {"id": ids}, CodecSettings(attributes=IDS)).data
        units = [unit for unit in read_units(data) if unit.kind is not UnitType.USER_DATA]
        bare = decode_cloud(b"".join(unit_bytes(unit.kind, bytes(unit.payload)) for unit in units))
        mine = decode_cloud(data).attributes["id"]
        assert np.array_equal(np.array(known)[np.searchsorted(expected, bare.attributes["reflectance"])], mine)
        assert np.unique(bare.attributes["reflectance"]).tolist() == expected


def test_ids_beside_a_reflectance_leave_its_scale_alone(surface: tuple) -> None:
    values = {"id": (surface[0][:, 0] % 9).astype(np.uint16), "reflectance": surface[1][:, 0]}
    stream = read_stream(encode_cloud(surface[0], values, CodecSettings(attributes=IDS)).data)
    assert [a.description.fraction_bits for a in stream.attributes] == [0, 0]


def test_tables_of_earlier_versions_are_read() -> None:
    table = read_table("id", {"ids": [3, 9, 400], "stride": 32767})
    assert table.ids[table.ranks(np.array([0, 32767, 65000, 40]))].tolist() == [3, 9, 400, 3]
    for damaged in ({"ids": 0, "bits": 3}, {"ids": [1], "bits": 16}, {"ids": [1]}, {"ids": [], "bits": 2}, 7):
        with pytest.raises(FormatError, match="table of the ids"):
            read_table("id", damaged)


def test_ids_are_cheap_where_they_rarely_change(surface: tuple) -> None:
    ids = (surface[0][:, 0] // 40 + 10 * (surface[0][:, 1] // 50)).astype(np.uint16)
    report = encode_cloud(surface[0], {"id": ids}, CodecSettings(attributes=IDS)).report
    assert 8 * report.attribute_bytes["id"] / len(ids) < 0.6


def test_the_step_stays_below_the_stride() -> None:
    for count in (2, 10, 500, 65536):
        table = IdTable.of(np.arange(count))
        step = 2 ** ((table.qp() - 4) / 6)
        assert step <= max(1, 0.3 * table.stride) + 1e-9


def test_merging_takes_means_and_most_frequent_ids() -> None:
    points = np.array([[5, 5, 5], [0, 0, 0], [5, 5, 5], [5, 5, 5], [0, 0, 0]])
    values = {
        "grey": np.array([10, 100, 20, 60, 101], np.uint8),
        "id": np.array([9, 4, 7, 7, 4], np.uint16),
    }
    settings = CodecSettings(qp=4, attributes=IDS)
    cloud = decode_cloud(encode_cloud(points, values, settings).data)
    assert cloud.points.tolist() == [[0, 0, 0], [5, 5, 5]]
    assert np.abs(cloud.attributes["grey"].astype(int) - [101, 30]).max() <= 1
    assert cloud.attributes["id"].tolist() == [4, 7]


def test_names_types_and_metadata(surface: tuple) -> None:
    points, colors = surface
    values = {
        "color": colors, "sh1": colors.astype(np.uint16) * 16, "opacity": colors[:, 0], "normal": colors,
        "sh2": colors.astype(np.uint16) * 8,
    }  # fmt: skip
    own = {"sh1": AttributeSettings(bit_depth=12), "sh2": AttributeSettings(bit_depth=11, label="color")}
    cloud = decode_cloud(encode_cloud(points, values, CodecSettings(attributes=own, metadata={"range": [0.5, 2]})).data)
    kinds = {name: (column.dtype.name, column.shape[1:]) for name, column in cloud.attributes.items()}
    assert kinds == {
        "color": ("uint8", (3,)), "sh1": ("uint16", (3,)), "opacity": ("uint8", ()), "normal": ("uint8", (3,)),
        "sh2": ("uint16", (3,)),
    }  # fmt: skip
    assert cloud.metadata == {"range": [0.5, 2]}


def test_a_cloud_without_attributes(surface: tuple) -> None:
    cloud = decode_cloud(encode_cloud(surface[0]).data)
    assert cloud.attributes == {} and len(cloud) == len(surface[0])


@pytest.mark.parametrize(
    ("values", "own", "message"),
    [
        (np.zeros((5, 3), np.uint8), {}, r"\[4\] or \[4, 3\]"),
        (np.zeros((4, 3)), {}, "whole numbers"),
        (np.full((4, 3), 300), {"bit_depth": 8}, "do not fit in 8 bits"),
        (np.full((4, 3), -1), {}, "do not fit"),
        (np.zeros((4, 3), np.uint8), {"lossless": True}, "one component"),
        (np.zeros(4, np.uint8), {"color_space": "ycbcr"}, "needs 3 components"),
        (np.zeros((4, 3), np.uint8), {"color_space": "ycbcr", "bit_depth": 10}, "needs 8 bits"),
        (np.zeros(4, np.uint8), {"label": "temperature"}, "temperature"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(values: np.ndarray, own: dict, message: str) -> None:
    settings = CodecSettings(attributes={"x": AttributeSettings(**own)})
    with pytest.raises(ConfigError, match=message):
        encode_cloud(np.arange(12).reshape(4, 3), {"x": values}, settings)


def test_settings_of_an_absent_attribute_are_refused() -> None:
    with pytest.raises(ConfigError, match="'id'"):
        encode_cloud(np.zeros((1, 3)), {}, CodecSettings(attributes=IDS))


def test_object_ids_come_back_exactly_without_being_asked() -> None:
    """An id beside the right one is another object."""
    grid = np.random.default_rng(0).integers(0, 30, (3000, 3))
    ids = np.where(grid[:, 0] < 15, 3, 900).astype(np.uint16)
    decoded = decode_cloud(encode_cloud(grid, {"object_id": ids}, CodecSettings(qp=40)).data)
    assert (decoded.attributes["object_id"] == np.where(decoded.points[:, 0] < 15, 3, 900)).all()


def test_a_quantiser_beyond_the_bits_is_refused() -> None:
    grid = np.arange(30).reshape(10, 3)
    colors, values = np.zeros((10, 3), np.uint8), np.arange(10, dtype=np.uint16)
    with pytest.raises(ConfigError, match="'color'.*qp.*4 to 51.*8.*99"):
        encode_cloud(grid, {"color": colors}, CodecSettings(qp=99))
    assert encode_cloud(grid, {"reflectance": values}, CodecSettings(qp=99)).data


def test_an_unknown_setting_is_named() -> None:
    with pytest.raises(ConfigError, match=r"CodecSettings.*\bvoxel\b.*voxel_size"):
        CodecSettings(voxel=3)  # type: ignore[call-arg]
