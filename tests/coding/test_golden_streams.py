# SPDX-License-Identifier: Apache-2.0
"""Streams of the reference encoder decode exactly, and our encoder writes the same geometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ggslam.coding import CodecSettings, decode_cloud, decode_slice, encode_cloud, list_slices
from ggslam.coding.container import UnitType, read_units
from ggslam.coding.slice_coder import SliceCoder
from ggslam.coding.stream import read_stream

NAMES = [
    "ctc_default_qp16", "duplicates_qp16", "full_qp10", "full_qp28", "lossy_half_qp34", "sibling_nopred_qp10",
    "slices_qp22",
]  # fmt: skip


def stream(folder: Path, name: str) -> bytes:
    return (folder / "golden" / f"{name}.bin").read_bytes()


def rows(points: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Points with colours in an order of their own."""
    table = np.concatenate([points.astype(np.int64), colors.astype(np.int64)], 1)
    return table[np.lexsort(table.T)]


@pytest.mark.parametrize("name", NAMES)
def test_golden_streams_decode_exactly(gpcc_data: Path, name: str) -> None:
    expected = np.load(gpcc_data / "golden" / f"{name}.npz")
    cloud = decode_cloud(stream(gpcc_data, name))
    assert np.array_equal(rows(cloud.points, cloud.attributes["color"]), rows(expected["points"], expected["colors"]))
    # The order is the reference decoder's too: slices as they come, Morton order within.
    assert np.array_equal(cloud.points, expected["points"])


@pytest.mark.parametrize("name", NAMES)
def test_geometry_is_coded_byte_for_byte(gpcc_data: Path, name: str) -> None:
    """From shuffled positions of each slice, on the golden stream's own partition."""
    for units in read_stream(stream(gpcc_data, name)).slices:
        header = units.header
        decoded = SliceCoder().decode_geometry(units.geometry, header, units.payload)
        coder = SliceCoder()
        coder.build(np.random.default_rng(0).permutation(decoded), header.depth)
        assert coder.encode_geometry(units.geometry) == bytes(units.payload)


@pytest.mark.parametrize(("name", "qp", "offset"), [("full_qp10", 10, 0), ("full_qp28", 28, -1)])
def test_the_source_is_coded_like_the_reference_does(gpcc_data: Path, name: str, qp: int, offset: int) -> None:
    """Geometry and attributes are the same to the byte."""
    source, golden = np.load(gpcc_data / "golden" / "source.npz"), stream(gpcc_data, name)
    ours = encode_cloud(source["points"], {"color": source["colors"]}, CodecSettings(qp=qp, chroma_offset=offset))
    units = [{unit.kind: bytes(unit.payload) for unit in read_units(data)} for data in (golden, ours.data)]
    assert units[0][UnitType.GEOMETRY_PARAMETERS] == units[1][UnitType.GEOMETRY_PARAMETERS]
    assert units[0][UnitType.GEOMETRY][3:] == units[1][UnitType.GEOMETRY][-len(units[0][UnitType.GEOMETRY]) + 3 :]
    assert units[0][UnitType.ATTRIBUTE] == units[1][UnitType.ATTRIBUTE]


def test_golden_slices_decode_alone(gpcc_data: Path) -> None:
    data = stream(gpcc_data, "slices_qp22")
    whole, start = decode_cloud(data), 0
    for info in list_slices(data):
        part = decode_slice(data, info.slice_id)
        end = start + info.points
        assert np.array_equal(part.grid_points, whole.grid_points[start:end])
        assert np.array_equal(part.attributes["color"], whole.attributes["color"][start:end])
        assert (part.points >= info.low).all() and (part.points <= info.high).all()
        start = end
    assert start == len(whole)


def test_slices_may_share_an_id(gpcc_data: Path) -> None:
    """Streams of single slices may be strung together behind one set of parameters."""
    data = stream(gpcc_data, "full_qp10")
    units = list(read_units(data))
    of_slices = (UnitType.GEOMETRY, UnitType.ATTRIBUTE)
    slices = b"".join(data[u.offset : u.offset + u.size] for u in units if u.kind in of_slices)
    cloud = decode_cloud(data + slices)
    one = decode_cloud(data)
    assert len(cloud) == 2 * len(one)
    assert np.array_equal(cloud.attributes["color"], np.concatenate([one.attributes["color"]] * 2))
