# SPDX-License-Identifier: Apache-2.0
"""Parameter sets and headers: what the reference encoder wrote is read and written alike, unknown tools are named."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import pytest

from ggslam.coding.attribute_syntax import AttributeHeader, AttributeParameters
from ggslam.coding.bits import BitWriter
from ggslam.coding.container import UnitType, read_units, unit_bytes
from ggslam.coding.geometry_syntax import ALL_AXES, GeometryHeader, GeometryParameters
from ggslam.coding.sequence_parameters import AttributeDescription, SequenceParameters
from ggslam.errors import FormatError

# From golden streams: lossy_half_qp34, full_qp10, full_qp28.
GOLDEN_SPS = bytes.fromhex("100000780082002095c2800202b64020")
GOLDEN_GPS = bytes.fromhex("00c1fb80")
GOLDEN_APS = bytes.fromhex("007a6b7600")


def flipped(data: bytes, *positions: int) -> bytes:
    bits = int.from_bytes(data, "big")
    for position in positions:
        bits ^= 1 << (8 * len(data) - 1 - position)
    return bits.to_bytes(len(data), "big")


def test_reference_sequence_parameters() -> None:
    parameters = SequenceParameters.read(GOLDEN_SPS)
    assert parameters.attributes == (AttributeDescription("color", 3, 8, 0, 1, True),)
    assert parameters.resolution == Fraction(1, 2) and not parameters.metres
    assert parameters.write() == GOLDEN_SPS


def test_reference_geometry_parameters() -> None:
    parameters = GeometryParameters.read(GOLDEN_GPS)
    assert parameters == GeometryParameters(True, 8, True, 6)
    assert parameters.write() == GOLDEN_GPS
    assert GeometryParameters.read(bytes.fromhex("00c020")).neighbour_boundary == 0


def test_reference_attribute_parameters() -> None:
    parameters = AttributeParameters.read(GOLDEN_APS)
    assert (parameters.qp, parameters.chroma_offset, parameters.thresholds) == (28, -1, (2, 6))
    assert parameters.write() == GOLDEN_APS


def test_sequence_parameters_come_back() -> None:
    attributes = (
        AttributeDescription("color", 3, 8, 0, 1),
        AttributeDescription("reflectance", 1, 16, 2),
        AttributeDescription("normal", 3, 12, 0, 0),
    )
    parameters = SequenceParameters(
        attributes, True, (-5, 0, 70000), 0, (9, 1, 2_000_000), Fraction(1000, 7), True, slice_tag_bits=3
    )
    assert SequenceParameters.read(parameters.write()) == parameters


@pytest.mark.parametrize("boundary", [0, 2, 5, 8])
def test_geometry_parameters_come_back(boundary: int) -> None:
    parameters = GeometryParameters(False, boundary, boundary > 0, 4 if boundary else 0, 3)
    assert GeometryParameters.read(parameters.write()) == parameters


def test_headers_come_back() -> None:
    sequence, geometry = SequenceParameters(frame_counter_bits=2), GeometryParameters()
    header = GeometryHeader(7, (0, 2_000_000, 3), (ALL_AXES,) * 21, 12345)
    payload = header.write(sequence, geometry) + b"payload" + header.footer()
    read, body = GeometryHeader.read(payload, sequence, geometry)
    assert read == header and bytes(body) == b"payload"
    parameters = AttributeParameters(30, slice_qp_deltas=True)
    attribute = AttributeHeader(7, 2, 0, (-3, 1))
    assert AttributeHeader.read(attribute.write(parameters) + b"xy", parameters)[0] == attribute


def test_quantiser_parameters_are_clipped() -> None:
    assert AttributeParameters(5, -9).qps(8) == (5, 4)
    assert AttributeParameters(60, 30).qps(8) == (51, 51)
    assert AttributeParameters(60, 30).qps(12) == (60, 75)


@pytest.mark.parametrize(
    ("bits", "tool"),
    [
        ((24,), "bytewise"), ((26,), "angular"), ((28,), "trisoup"),
    ],
)  # fmt: skip
def test_unsupported_geometry_is_named(bits: tuple[int, ...], tool: str) -> None:
    with pytest.raises(FormatError, match=tool):
        GeometryParameters.read(flipped(GOLDEN_GPS, *bits))


def test_unsupported_attribute_coding_is_named() -> None:
    writer = BitWriter()
    writer.u(8, 0)
    writer.ue(9)
    with pytest.raises(FormatError, match=r"kind 9\b"):
        AttributeParameters.read(writer.data())


def test_sequences_without_a_profile_are_refused() -> None:
    with pytest.raises(FormatError, match="second edition"):
        SequenceParameters.read(SequenceParameters(profiles=(False,) * 4).write())


def test_a_sequence_of_the_second_edition_is_recognised() -> None:
    """The drafts have other profile bits and Golomb codes with a prefix of zeros."""
    with pytest.raises(FormatError, match="second edition"):
        SequenceParameters.read(flipped(GOLDEN_SPS, 20))


@pytest.mark.parametrize("near", [False, True])
def test_tools_of_sparse_clouds_come_back(near: bool) -> None:
    parameters = GeometryParameters(True, 8 if near else 0, near, 0, partial_splits=True, planes=True,
                                    plane_thresholds=(77, 99, 113))  # fmt: skip
    assert GeometryParameters.read(parameters.write()) == parameters
    sequence, axes = SequenceParameters(), (6, 6, 7, 1, 2, 4)
    header = GeometryHeader(1, (1, 2, 3), axes, 50)
    payload = header.write(sequence, parameters) + b"payload" + header.footer()
    read, body = GeometryHeader.read(payload, sequence, parameters)
    assert read == header and bytes(body) == b"payload" and read.size_log2 == (4, 4, 2) and read.depth == 4


def test_deep_octrees_are_refused() -> None:
    sequence, geometry = SequenceParameters(), GeometryParameters()
    header = GeometryHeader(0, (0, 0, 0), (ALL_AXES,) * 22, 1)
    with pytest.raises(FormatError, match=r"\b22 levels"):
        GeometryHeader.read(header.write(sequence, geometry) + b"\x00" * 9, sequence, geometry)


def test_units_come_back() -> None:
    data = unit_bytes(UnitType.GEOMETRY, b"abc") + unit_bytes(UnitType.USER_DATA, b"")
    units = list(read_units(data))
    assert [(u.kind, bytes(u.payload), u.offset, u.size) for u in units] == [
        (UnitType.GEOMETRY, b"abc", 0, 8), (UnitType.USER_DATA, b"", 8, 5),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"\x00\x00", "within the header"),
        (b"\x63\x00\x00\x00\x00", "type 99"),
        (b"\x00\x00\x00\x00\x05a", "5 .*1 "),
    ],
)
def test_damaged_units_are_refused(data: bytes, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        list(read_units(data))


def test_impossible_quantiser_parameters_are_refused() -> None:
    with pytest.raises(FormatError, match="impossible values"):
        AttributeParameters.read(replace(AttributeParameters(20), qp=200).write())
