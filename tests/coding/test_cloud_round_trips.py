# SPDX-License-Identifier: Apache-2.0
"""Whatever the cloud and the settings: the decoder returns what the encoder said it would."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ggslam.coding import AttributeSettings, CodecSettings, PointCloud, decode_cloud, decode_slice, encode_cloud


@st.composite
def clouds(draw: st.DrawFn) -> np.ndarray:
    """Integer points: single, all equal, on a line, dense, sparse, at the corners of 21 bits."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    count = draw(st.sampled_from([1, 1, 2, 7, 60, 800, 3000]))
    kind = draw(st.sampled_from(["sparse", "equal", "line", "dense", "plane", "corners"]))
    if kind == "sparse":
        return rng.integers(0, 1 << draw(st.integers(1, 21)), (count, 3))
    if kind == "equal":
        return np.full((count, 3), draw(st.integers(-(2**30), 2**30)))
    if kind == "line":
        return np.outer(np.arange(count), rng.integers(0, 4, 3))
    if kind == "dense":
        return rng.integers(0, max(2, round(count ** (1 / 3))), (count, 3))
    if kind == "plane":
        return np.c_[rng.integers(0, 50, (count, 2)), np.full(count, 7)]
    return rng.integers(0, 2, (count, 3)) * (2**21 - 1)


@st.composite
def attributes(draw: st.DrawFn, count: int) -> tuple[dict[str, np.ndarray], dict[str, AttributeSettings]]:
    """Colours, something of 8 to 16 bits with 1 or 3 components, and ids."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    bits, components = draw(st.sampled_from([8, 10, 12, 16])), draw(st.sampled_from([1, 3]))
    space = draw(st.sampled_from(["ycbcr", "identity", "none"]))
    values = {
        "color": rng.integers(0, 256, (count, 3)).astype(np.uint8),
        "other": rng.integers(0, 1 << bits, (count, components)).astype(np.uint16),
        "id": rng.integers(0, draw(st.sampled_from([1, 2, 40, 65536])), count).astype(np.uint16),
    }
    own = {
        "color": AttributeSettings(color_space=space),
        "other": AttributeSettings(bit_depth=bits, qp=draw(st.integers(4, 51 + 6 * (bits - 8)))),
        "id": AttributeSettings(lossless=True),
    }
    return values, own


codec_settings = st.fixed_dictionaries(
    {
        "qp": st.integers(4, 51),
        "chroma_offset": st.integers(-6, 6),
        "duplicates": st.sampled_from(["merge", "keep"]),
        "slices": st.integers(1, 4),
        "split": st.sampled_from(["count", "interval", "cube"]),
        "neighbour_boundary": st.sampled_from([None, 0, 2, 3, 5, 8]),
        "adjacent_child": st.booleans(),
        "intra_prediction_size": st.integers(0, 8),
        "raht_prediction": st.booleans(),
        "rdoq": st.sampled_from([0.0, 1.0]), "planes": st.sampled_from([None, False, True]),
    }
)


def assert_same(found: PointCloud, expected: PointCloud) -> None:
    assert np.array_equal(found.grid_points, expected.grid_points)
    assert np.array_equal(found.points, expected.points)
    assert list(found.attributes) == list(expected.attributes)
    for name, values in expected.attributes.items():
        assert found.attributes[name].dtype == values.dtype
        assert np.array_equal(found.attributes[name], values)


def sorted_rows(*columns: np.ndarray) -> np.ndarray:
    table = np.column_stack([column.astype(np.int64) for column in columns])
    return table[np.lexsort(table.T)]


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(data=st.data(), points=clouds(), choices=codec_settings)
def test_decoding_gives_the_promised_reconstruction(data: Any, points: np.ndarray, choices: dict) -> None:
    values, own = data.draw(attributes(len(points)))
    codec = CodecSettings(threads=1, attributes=own, **choices)
    coded = encode_cloud(points, values, codec, reconstruct=True)
    cloud = decode_cloud(coded.data, threads=1)
    assert coded.reconstruction is not None
    assert_same(cloud, coded.reconstruction)
    if choices["duplicates"] == "keep":
        # Lossless: every position as often as it came, with its id.
        expected = sorted_rows(points, values["id"])
        assert np.array_equal(sorted_rows(cloud.points, cloud.attributes["id"]), expected)
    else:
        assert np.array_equal(sorted_rows(cloud.points), sorted_rows(np.unique(points, axis=0)))


@settings(max_examples=25, deadline=None)
@given(data=st.data(), points=clouds(), choices=codec_settings)
def test_slices_and_threads_do_not_matter(data: Any, points: np.ndarray, choices: dict) -> None:
    values, own = data.draw(attributes(len(points)))
    coded = [encode_cloud(points, values, CodecSettings(threads=w, attributes=own, **choices)) for w in (1, 3)]
    assert coded[0].data == coded[1].data
    whole = decode_cloud(coded[0].data, threads=3)
    start = 0
    for report in coded[0].report.slices:
        part = decode_slice(coded[0].data, report.slice_id)
        end = start + report.points
        expected = {name: column[start:end] for name, column in whole.attributes.items()}
        assert_same(part, PointCloud(whole.grid_points[start:end], expected, whole.quantization))
        start = end
    assert start == len(whole)


@pytest.mark.parametrize("bits", [7, 21])
def test_many_points(bits: int) -> None:
    """200,000 points, dense or far apart."""
    rng = np.random.default_rng(bits)
    points = rng.integers(0, 1 << bits, (200_000, 3))
    colors = (points >> max(0, bits - 8)).astype(np.uint8)
    coded = encode_cloud(points, {"color": colors}, CodecSettings(slices=3), reconstruct=True)
    assert coded.reconstruction is not None
    cloud = decode_cloud(coded.data)
    assert_same(cloud, coded.reconstruction)
    assert len(cloud) == len(np.unique(points, axis=0)) == coded.report.points


def test_report_adds_up(surface: tuple) -> None:
    points, colors = surface
    coded = encode_cloud(points, {"color": colors, "grey": colors[:, 0]}, CodecSettings(slices=3))
    report = coded.report
    assert report.total_bytes == len(coded.data)
    units = report.geometry_bytes + sum(report.attribute_bytes.values())
    assert 0 < report.total_bytes - units < 200  # parameter sets and names
    assert report.input_points == report.points == len(points)
    assert report.bits_per_point == pytest.approx(8 * len(coded.data) / len(points))


def test_bits_are_few_on_a_surface(surface: tuple) -> None:
    """Contexts and prediction work: a smooth sheet costs little, and less than with siblings only."""
    points, colors = surface
    sizes = [
        encode_cloud(points, {"color": colors}, CodecSettings(neighbour_boundary=boundary)).report.geometry_bytes
        for boundary in (8, 0)
    ]
    assert 8 * sizes[0] / len(points) < 1.2
    assert sizes[0] < 0.75 * sizes[1]


def test_sparse_clouds_need_no_neighbours() -> None:
    rng = np.random.default_rng(0)
    points = rng.integers(0, 1 << 18, (5000, 3))
    assert encode_cloud(points).data == encode_cloud(points, settings=CodecSettings(neighbour_boundary=0)).data
