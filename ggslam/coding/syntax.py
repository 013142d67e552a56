# SPDX-License-Identifier: Apache-2.0
"""Geometry and attribute parameter sets, and the headers of the data units (ISO/IEC 23090-9, first edition).

Reading stops with a FormatError that names the first tool which this decoder lacks.
"""

from __future__ import annotations

from dataclasses import dataclass

from ggslam.coding.bits import BitReader, BitWriter
from ggslam.coding.sequence_parameters import SequenceParameters
from ggslam.errors import FormatError

MAX_DEPTH = 21
"""Levels of an octree that are supported: positions of 21 bits."""
MAX_PARAMETER_SETS = 16
"""Attribute parameter sets of a stream: their ids have 4 bits."""
FOOTER_BYTES = 3
_HEADER_BYTES = 64  # no valid header is longer
RAHT, PREDICTING, LIFTING, RAW = 0, 1, 2, 3
_ENCODINGS = {PREDICTING: "the predicting transform", LIFTING: "the lifting transform", RAW: "raw attribute coding"}


def _refuse(present: bool, tool: str) -> None:
    if present:
        raise FormatError(f"the stream uses {tool}, which is not supported")


@dataclass(frozen=True)
class GeometryParameters:
    """The geometry parameter set, for octree coding without planar, angular and direct modes.

    `neighbour_boundary` n: neighbours are looked up within cubes of 2^n nodes, 2 to 8; 0: siblings only.
    """

    unique_points: bool = True
    neighbour_boundary: int = 8
    adjacent_child: bool = True
    intra_prediction: int = 6
    geometry_id: int = 0
    sequence_id: int = 0
    box_scale_present: bool = True
    box_log2_scale: int = 0

    def write(self) -> bytes:
        w = BitWriter()
        w.u(4, self.geometry_id)
        w.u(4, self.sequence_id)
        w.flag(self.box_scale_present)
        if not self.box_scale_present:
            w.ue(self.box_log2_scale)
        w.flag(self.unique_points)
        w.u(2, 0)  # no predictive geometry, no list of point counts
        w.u(3, 0)  # no direct mode, no quadtree or binary tree
        w.u(3, max(0, self.neighbour_boundary - 1))
        if self.neighbour_boundary:
            w.flag(self.adjacent_child)
            w.ue(self.intra_prediction)
        w.flag(True)  # bitwise occupancy coding
        w.u(4, 0)  # no planar mode, angular mode, scaling, extension
        return w.data()

    @staticmethod
    def read(payload: bytes | memoryview) -> GeometryParameters:
        r = BitReader(payload, "the geometry parameter set")
        identity, sequence, present = r.u(4), r.u(4), r.flag()
        box_scale = 0 if present else r.ue()
        unique = r.flag()
        _refuse(r.flag(), "predictive geometry")
        _refuse(r.flag(), "a list of the point counts of octree levels")
        _refuse(r.u(2) != 0, "direct coding of points (IDCM)")
        _refuse(r.flag(), "quadtree and binary tree partitions (QTBT)")
        code = r.u(3)
        adjacent, intra = (r.flag(), r.ue()) if code else (False, 0)
        bitwise = r.flag()
        _refuse(not bitwise, "bytewise occupancy coding")
        _refuse(r.flag(), "the planar mode")
        _refuse(r.flag(), "the angular mode")
        _refuse(r.flag(), "geometry scaling")
        _refuse(r.flag(), "an extension of the geometry parameter set (trisoup, or a second-edition tool)")
        r.finish()
        boundary = code + 1 if code else 0
        return GeometryParameters(unique, boundary, adjacent, intra, identity, sequence, present, box_scale)


@dataclass(frozen=True)
class AttributeParameters:
    """The attribute parameter set, for the region-adaptive hierarchical transform."""

    qp: int
    chroma_offset: int = 0
    prediction: bool = True
    thresholds: tuple[int, int] = (2, 6)
    slice_qp_deltas: bool = False
    attribute_id: int = 0
    sequence_id: int = 0

    def write(self) -> bytes:
        w = BitWriter()
        w.u(4, self.attribute_id)
        w.u(4, self.sequence_id)
        w.ue(RAHT)
        w.ue(self.qp - 4)
        w.se(self.chroma_offset)
        w.flag(self.slice_qp_deltas)
        w.flag(self.prediction)
        if self.prediction:
            w.ue(self.thresholds[0])
            w.ue(self.thresholds[1])
        w.u(2, 0)  # no spherical coordinates, no extension
        return w.data()

    @staticmethod
    def read(payload: bytes | memoryview) -> AttributeParameters:
        r = BitReader(payload, "an attribute parameter set")
        identity, sequence, encoding = r.u(4), r.u(4), r.ue()
        _refuse(encoding != RAHT, _ENCODINGS.get(encoding, f"attribute coding of the unknown kind {encoding}"))
        qp, chroma, deltas = r.ue() + 4, r.se(), r.flag()
        prediction = r.flag()
        thresholds = (r.ue(), r.ue()) if prediction else (0, 0)
        _refuse(r.flag(), "attribute coding in spherical coordinates")
        _refuse(r.flag(), "an extension of an attribute parameter set (a second-edition tool)")
        r.finish()
        if qp > 99 or abs(chroma) > 99 or max(thresholds) > 255:
            raise FormatError("an attribute parameter set holds impossible values")
        return AttributeParameters(qp, chroma, prediction, thresholds, deltas, identity, sequence)

    def qps(self, bit_depth: int, deltas: tuple[int, int] = (0, 0)) -> tuple[int, int]:
        """Quantiser parameters of component 0 and of the others, after a slice's deltas."""
        highest = 51 + 6 * max(0, bit_depth - 8)
        first = min(max(self.qp + deltas[0], 4), highest)
        return first, min(max(first + self.chroma_offset + deltas[1], 4), highest)


@dataclass(frozen=True)
class GeometryHeader:
    """The header (and footer) of a geometry data unit: one slice."""

    slice_id: int
    origin: tuple[int, int, int]
    depth: int
    points: int
    geometry_id: int = 0
    slice_tag: int = 0
    frame: int = 0
    box_log2_scale: int = 0

    @property
    def grid_origin(self) -> tuple[int, int, int]:
        """Where the slice's own coordinates begin, in the grid of the sequence."""
        x, y, z = (v << self.box_log2_scale for v in self.origin)
        return x, y, z

    def write(self, sequence: SequenceParameters, geometry: GeometryParameters) -> bytes:
        """The header; the payload and then `footer()` follow it."""
        w = BitWriter()
        w.u(4, self.geometry_id)
        w.u(3, 0)
        w.ue(self.slice_id)
        w.u(sequence.slice_tag_bits, self.slice_tag)
        w.u(sequence.frame_counter_bits, self.frame)
        if geometry.box_scale_present:
            w.ue(self.box_log2_scale)
        bits = max(1, max(v.bit_length() for v in self.origin))
        w.ue(bits - 1)
        for v in self.origin:
            w.u(bits, v)
        w.ue(self.depth - 1)
        w.ue(0)  # one arithmetic codeword
        return w.data()

    def footer(self) -> bytes:
        return (self.points - 1).to_bytes(FOOTER_BYTES, "big")

    @staticmethod
    def parameter_set_of(payload: bytes | memoryview) -> int:
        """Id of the parameter set that a geometry unit refers to."""
        return BitReader(payload[:1], "a geometry data unit").u(4)

    @staticmethod
    def read(
        payload: bytes | memoryview, sequence: SequenceParameters, geometry: GeometryParameters
    ) -> tuple[GeometryHeader, memoryview]:
        """The header, and the arithmetic payload between it and the footer."""
        if len(payload) <= FOOTER_BYTES:
            raise FormatError(f"a geometry data unit of {len(payload)} bytes")
        view = memoryview(payload)
        body = view[:-FOOTER_BYTES]
        r = BitReader(body[:_HEADER_BYTES], "the header of a geometry data unit")
        identity = r.u(4)
        r.u(3)
        slice_id, tag, frame = r.ue(), r.u(sequence.slice_tag_bits), r.u(sequence.frame_counter_bits)
        scale = r.ue() if geometry.box_scale_present else geometry.box_log2_scale
        bits = r.ue() + 1
        if bits > 32 or scale > 32:
            raise FormatError(f"slice {slice_id}: impossible origin in the header")
        origin = (r.u(bits), r.u(bits), r.u(bits))
        depth = r.ue() + 1
        _refuse(r.ue() != 0, "several arithmetic codewords in a geometry data unit")
        r.align()
        if depth > MAX_DEPTH:
            raise FormatError(f"slice {slice_id}: an octree of {depth} levels; {MAX_DEPTH} are supported")
        points = int.from_bytes(view[-FOOTER_BYTES:], "big") + 1
        header = GeometryHeader(slice_id, origin, depth, points, identity, tag, frame, scale)
        if max(header.grid_origin) + (1 << depth) > 1 << 31:
            raise FormatError(f"slice {slice_id} lies outside the range of 31-bit positions")
        return header, body[r.byte_position :]


@dataclass(frozen=True)
class AttributeHeader:
    """The header of an attribute data unit."""

    slice_id: int
    attribute: int = 0
    attribute_id: int = 0
    qp_deltas: tuple[int, int] = (0, 0)

    def write(self, parameters: AttributeParameters) -> bytes:
        w = BitWriter()
        w.u(4, self.attribute_id)
        w.u(3, 0)
        w.ue(self.attribute)
        w.ue(self.slice_id)
        if parameters.slice_qp_deltas:
            w.se(self.qp_deltas[0])
            w.se(self.qp_deltas[1])
        w.flag(False)  # no quantiser offsets by level
        w.ue(0)  # nor by region
        return w.data()

    @staticmethod
    def parameter_set_of(payload: bytes | memoryview) -> int:
        """Id of the parameter set that an attribute unit refers to."""
        return BitReader(payload[:1], "an attribute data unit").u(4)

    @staticmethod
    def read(payload: bytes | memoryview, parameters: AttributeParameters) -> tuple[AttributeHeader, memoryview]:
        """The header, and the arithmetic payload after it."""
        r = BitReader(payload[:_HEADER_BYTES], "the header of an attribute data unit")
        identity = r.u(4)
        r.u(3)
        attribute, slice_id = r.ue(), r.ue()
        deltas = (r.se(), r.se()) if parameters.slice_qp_deltas else (0, 0)
        _refuse(r.flag(), "quantiser offsets by octree level")
        _refuse(r.ue() != 0, "quantiser offsets by region")
        r.align()
        if max(map(abs, deltas)) > 99:
            raise FormatError(f"slice {slice_id}: impossible quantiser offsets")
        return AttributeHeader(slice_id, attribute, identity, deltas), memoryview(payload)[r.byte_position :]
