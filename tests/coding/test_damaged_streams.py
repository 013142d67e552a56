# SPDX-License-Identifier: Apache-2.0
"""Damaged streams end in FormatError or in some cloud, never in a crash, a hang or a huge allocation."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from ggslam.coding import AttributeSettings, CodecSettings, decode_cloud, encode_cloud
from ggslam.coding.attribute_syntax import (
    LIFTING,
    PREDICTING,
    RAW,
    AttributeHeader,
    AttributeParameters,
    DetailSettings,
)
from ggslam.coding.container import HEADER, UnitType, read_units, unit_bytes
from ggslam.coding.decoder import decode_in_parts, decode_slice, list_slices
from ggslam.coding.geometry_syntax import ALL_AXES, GeometryHeader, GeometryParameters
from ggslam.coding.native_settings import AttributePayload, CodingContext, RahtSettings
from ggslam.coding.sequence_parameters import AttributeDescription
from ggslam.coding.slice_coder import SliceCoder
from ggslam.errors import FormatError


@pytest.fixture(scope="module")
def streams() -> list[bytes]:
    rng = np.random.default_rng(0)
    made = []
    kinds = [(1, 3, 8, "merge"), (900, 5, 8, "keep"), (400, 21, 0, "keep"), (2000, 5, 8, "merge")]
    for count, bits, boundary, duplicates in kinds:
        values = {
            "color": rng.integers(0, 256, (count, 3)).astype(np.uint8),
            "id": rng.integers(0, 30, count).astype(np.uint16),
            "depth": rng.integers(0, 4096, count).astype(np.uint16),
        }
        settings = CodecSettings(
            slices=2, neighbour_boundary=boundary, duplicates=duplicates, threads=1,
            attributes={"id": AttributeSettings(lossless=True), "depth": AttributeSettings(bit_depth=12)},
        )  # fmt: skip
        made.append(encode_cloud(rng.integers(0, 1 << bits, (count, 3)), values, settings).data)
    return made


def header_of(depth: int, points: int) -> GeometryHeader:
    return GeometryHeader(0, (0, 0, 0), (ALL_AXES,) * depth, points)


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    out = bytearray(data)
    kind = rng.integers(5)
    at = int(rng.integers(len(out)))
    if kind == 0:
        return bytes(out[:at])
    if kind == 1:
        for _ in range(int(rng.integers(1, 8))):
            out[int(rng.integers(len(out)))] = int(rng.integers(256))
    elif kind == 2:
        out[at : at + 30] = rng.integers(0, 256, int(rng.integers(40)), dtype=np.uint8).tobytes()
    elif kind == 3:
        out[at : at + 500] = bytes([int(rng.choice([0, 255]))]) * len(out[at : at + 500])
    else:  # within a unit, so that the container stays whole
        units = [[unit.kind, bytearray(unit.payload)] for unit in read_units(data)]
        payload = units[int(rng.integers(len(units)))][1]
        if rng.random() < 0.5:
            payload[int(rng.integers(len(payload)))] ^= 1 << int(rng.integers(8))
        else:
            del payload[int(rng.integers(len(payload))) :]
        return b"".join(unit_bytes(kind, bytes(content)) for kind, content in units)
    return bytes(out)


def test_damage_never_does_harm(streams: list[bytes]) -> None:
    rng = np.random.default_rng(1)
    outcomes = {"decoded": 0, "refused": 0}
    for _ in range(600):
        data = damaged(streams[int(rng.integers(len(streams)))], rng)
        start = time.process_time()
        try:
            decode_cloud(data, threads=1)
            outcomes["decoded"] += 1
        except FormatError as error:
            assert str(error)
            outcomes["refused"] += 1
        assert time.process_time() - start < 5
    assert outcomes["refused"] > 300


def test_every_truncation_is_noticed(streams: list[bytes]) -> None:
    """Of the container: the units themselves end early."""
    data = streams[1]
    ends = {unit.offset for unit in read_units(data)} | {len(data)}
    for length in range(0, len(data), 7):
        if length not in ends:
            with pytest.raises(FormatError):
                decode_cloud(data[:length], threads=1)


def test_a_stream_that_ends_between_two_slices_is_noticed() -> None:
    grid = np.random.default_rng(0).integers(0, 64, (2000, 3))
    data = encode_cloud(grid, {}, CodecSettings(slices=4)).data
    sizes = np.cumsum([units.size_bytes for units in list_slices(data)])
    assert len(sizes) == 4
    for there in (1, 2, 3):
        cut = data[: len(data) - int(sizes[-1] - sizes[there - 1])]
        with pytest.raises(FormatError, match=f"{there} of .*4 slices"):
            decode_cloud(cut)
        with pytest.raises(FormatError, match=f"{there} of .*4 slices"):
            decode_in_parts(cut)
        assert len(decode_slice(cut, 0)) == len(decode_slice(data, 0))


def test_a_truncated_payload_is_noticed() -> None:
    """A decoder that made up bits past the end would run on; this one stops."""
    points = np.random.default_rng(0).integers(0, 1 << 12, (3000, 3))
    parameters = GeometryParameters(False, 8)
    coder = SliceCoder()
    coder.build(points, 12)
    payload = coder.encode_geometry(parameters)
    for length in (0, 1, 2, 100, len(payload) // 2, len(payload) - 20):
        with pytest.raises(FormatError, match=r"ends early|number of points"):
            SliceCoder().decode_geometry(parameters, header_of(12, 3000), payload[:length])
    with pytest.raises(FormatError, match="another number of points"):
        SliceCoder().decode_geometry(parameters, header_of(12, 2999), payload)


@pytest.mark.parametrize("fill", [0, 255, None])
def test_made_up_payloads(fill: int | None) -> None:
    """Random contents at every depth; the octree may claim anything."""
    rng = np.random.default_rng(0)
    for depth in range(1, 22):
        payload = rng.integers(0, 256, 400, dtype=np.uint8).tobytes() if fill is None else bytes([fill]) * 400
        for unique in (False, True):
            with pytest.raises(FormatError):
                SliceCoder().decode_geometry(GeometryParameters(unique, 8), header_of(depth, 1 << 24), payload)
        coder = SliceCoder()
        coder.build(rng.integers(0, 1 << depth, (50, 3)), depth)
        for components in (1, 3):
            try:
                values = coder.decode_attribute(RahtSettings(components, 8, 51, 51, 1, 2, 6, index=-1), payload)
                assert values.min() >= 0 and values.max() <= 255
            except FormatError:
                pass


def test_a_stream_cannot_claim_more_points_than_it_can_hold(streams: list[bytes]) -> None:
    units = [(unit.kind, bytes(unit.payload)) for unit in read_units(streams[0])]
    units = [(k, p[:-3] + b"\xff\xff\xff" if k == UnitType.GEOMETRY else p) for k, p in units]
    with pytest.raises(FormatError, match="16777216"):
        decode_cloud(b"".join(unit_bytes(kind, payload) for kind, payload in units))


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (UnitType.CONSTANT_ATTRIBUTE, "constant attribute"),
        (UnitType.ATTRIBUTE_PARAMETER_INVENTORY, "attribute parameter inventory"),
    ],
)
def test_unsupported_units_are_named(streams: list[bytes], kind: UnitType, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        decode_cloud(streams[0] + unit_bytes(kind, b"\x00"))


@pytest.mark.parametrize("kind", [UnitType.TILE_INVENTORY, UnitType.FRAME_BOUNDARY, UnitType.USER_DATA])
def test_other_units_are_skipped(streams: list[bytes], kind: UnitType) -> None:
    plain = decode_cloud(streams[1])
    cloud = decode_cloud(streams[1] + unit_bytes(kind, b"\x12\x34"))
    assert np.array_equal(cloud.grid_points, plain.grid_points)


@pytest.mark.parametrize(
    ("dropped", "message"),
    [
        (UnitType.SEQUENCE_PARAMETERS, "before the sequence parameter set"),
        (UnitType.GEOMETRY_PARAMETERS, "geometry parameter set"),
        (UnitType.GEOMETRY, "before the geometry"),
        (UnitType.ATTRIBUTE_PARAMETERS, "parameter set 0"),
        (UnitType.ATTRIBUTE, "attribute 0"),
    ],
)
def test_missing_units_are_named(streams: list[bytes], dropped: UnitType, message: str) -> None:
    data = b"".join(unit_bytes(u.kind, bytes(u.payload)) for u in read_units(streams[1]) if u.kind != dropped)
    with pytest.raises(FormatError, match=message):
        decode_cloud(data)


def test_nothing_is_no_stream() -> None:
    with pytest.raises(FormatError, match="no slice"):
        decode_cloud(b"")
    with pytest.raises(FormatError, match="type"):
        decode_cloud(b"ply\nformat ascii 1.0\n" + bytes(HEADER.size))


def test_damage_to_streams_of_every_tool(gpcc_data: Path) -> None:
    """Streams of the reference encoder with planes, partial splits, direct points, prediction, lifting, ..."""
    rng = np.random.default_rng(3)
    files = sorted((gpcc_data / "golden_more").glob("*__*.bin"))
    if not files:
        pytest.skip("no streams of single tools")
    outcomes = {"decoded": 0, "refused": 0}
    for path in files:
        data = path.read_bytes()
        for _ in range(12):
            start = time.perf_counter()
            try:
                decode_cloud(damaged(data, rng), threads=1)
                outcomes["decoded"] += 1
            except FormatError as error:
                assert str(error)
                outcomes["refused"] += 1
            assert time.perf_counter() - start < 5
    assert outcomes["refused"] > len(files)


@pytest.mark.parametrize("fill", [0, 255, None])
@pytest.mark.parametrize("boundary", [0, 4, 8])
def test_made_up_payloads_of_other_trees(fill: int | None, boundary: int) -> None:
    """A tree may claim anything, too, whatever its levels split and whatever tools it has."""
    rng = np.random.default_rng(0)
    tools = {"direct_mode": 3, "direct_pairs": True, "planes": True, "plane_thresholds": (1, 1, 1)}
    for levels in (1, 8, 21, 60):
        axes = (7,) * levels if levels <= 21 else (4, 2, 1) * 20
        header = GeometryHeader(0, (0, 0, 0), axes, 1 << 24, codewords=min(3, levels), qp_offset=40)
        payload = rng.integers(0, 256, 400, dtype=np.uint8).tobytes() if fill is None else bytes([fill]) * 400
        for unique, scaling, bits in ((True, False, False), (False, True, True)):
            parameters = GeometryParameters(
                unique, boundary, boundary > 0, 6 if boundary else 0, partial_splits=True, scaling=scaling, **tools
            )
            with pytest.raises(FormatError):
                SliceCoder().decode_geometry(parameters, header, payload, CodingContext(bits))
    predictive = GeometryParameters(False, predictive=True, scaling=True)
    header = GeometryHeader(0, (0, 0, 0), (), 1 << 24, residual_bits=(7, 7, 7))
    with pytest.raises(FormatError):
        SliceCoder().decode_geometry(predictive, header, payload)


@pytest.mark.parametrize("encoding", [PREDICTING, LIFTING, RAW])
@pytest.mark.parametrize("fill", [0, 255, None])
def test_made_up_attributes(encoding: int, fill: int | None) -> None:
    rng = np.random.default_rng(0)
    payload = rng.integers(0, 256, 300, dtype=np.uint8).tobytes() if fill is None else bytes([fill]) * 300
    details = DetailSettings(3, 128, (1, 1, 8), 6, direct_predictors=3, search_within=64, skip_layers=0, blend=True)
    for components, bits in ((1, 8), (3, 16)):
        coder = SliceCoder()
        coder.build(rng.integers(0, 1 << 6, (80, 3)), 6)
        parameters = AttributeParameters(51, encoding=encoding, details=details, variable_length=components == 1)
        unit = AttributePayload(AttributeHeader(0), parameters, memoryview(payload))
        try:
            values = coder.decode_unit(unit, AttributeDescription("color", components, bits), CodingContext())
            assert values.min() >= 0 and values.max() < 1 << 16
        except FormatError:
            pass
