# SPDX-License-Identifier: Apache-2.0
"""The geometry parameter set and the headers of geometry data units (ISO/IEC 23090-9, first edition).

Reading stops with a FormatError that names the first tool which this decoder lacks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from ggslam.coding.bits import BitReader, BitWriter
from ggslam.coding.sequence_parameters import SequenceParameters
from ggslam.errors import FormatError
from ggslam.system.tuning import Tuning

MAX_DEPTH: Final = 21
"""Bits of a position's coordinate, in a slice as on the grid: three of them fit a 63-bit code."""
MAX_LEVELS: Final = 63
"""Levels of a tree: one for each bit of the three coordinates."""
ALL_AXES: Final = 7
"""A level that splits along all axes: one bit for each."""
FOOTER_BYTES: Final = 3
"""Bytes of the number of points at the end of a geometry data unit."""


class GeometryLimits(Tuning):
    """A limit on hostile streams."""

    header_bytes = 256
    """Bytes of a geometry data unit that its header is read from; no valid header is longer."""


def refuse(present: bool, tool: str) -> None:
    """Raises FormatError for a tool that is not supported."""
    if present:
        raise FormatError(f"the stream uses {tool}, which is not supported")


@dataclass(frozen=True)
class GeometryParameters:
    """The geometry parameter set, without the angular mode.

    `neighbour_boundary` n: neighbours are looked up within cubes of 2^n nodes, 2 to 8; 0: siblings only.
    `direct_mode`: 0 to 3, points may be coded directly where they are sparse (IDCM).
    `partial_splits`: a level may split its nodes along some axes only (quadtree and binary tree: QTBT).
    `planes`: the planar mode, with thresholds; `direct_rate` of 32 candidates may be direct beside it.
    `scaling`: positions may be coded with a quantiser, in steps of 2^(qp / 8) (8 + qp % 8) / 8 of a voxel.
    """

    unique_points: bool = True
    neighbour_boundary: int = 8
    adjacent_child: bool = True
    intra_prediction: int = 6
    geometry_id: int = 0
    sequence_id: int = 0
    box_scale_present: bool = True
    box_log2_scale: int = 0
    predictive: bool = False
    point_counts: bool = False
    direct_mode: int = 0
    direct_pairs: bool = False
    partial_splits: bool = False
    planes: bool = False
    plane_thresholds: tuple[int, int, int] = (0, 0, 0)
    direct_rate: int = 32
    scaling: bool = False
    base_qp: int = 0
    qp_shift: int = 0
    direct_qp_offset: int = 0
    qp_interval_log2: int = 0

    @property
    def plain_octree(self) -> bool:
        """Whether the fast octree coder has all tools that this set names."""
        others = (self.predictive, self.direct_mode, self.partial_splits, self.planes, self.scaling)
        return not any(others)

    def write(self) -> bytes:
        """The payload of the unit, of a set without predictive geometry and direct mode."""
        w = BitWriter()
        w.u(4, self.geometry_id)
        w.u(4, self.sequence_id)
        w.flag(self.box_scale_present)
        if not self.box_scale_present:
            w.ue(self.box_log2_scale)
        w.flag(self.unique_points)
        w.u(2, 0)  # no predictive geometry, no list of point counts
        w.u(2, 0)  # no direct mode
        w.flag(self.partial_splits)
        w.u(3, max(0, self.neighbour_boundary - 1))
        if self.neighbour_boundary:
            w.flag(self.adjacent_child)
            w.ue(self.intra_prediction)
        w.flag(True)  # bitwise occupancy coding
        w.flag(self.planes)
        if self.planes:
            for threshold in self.plane_thresholds:
                w.ue(threshold)
        w.flag(False)  # no angular mode
        w.flag(self.scaling)
        if self.scaling:
            w.ue(self.base_qp)
            w.u(2, self.qp_shift)
        w.flag(False)  # no extension
        return w.data()

    @staticmethod
    def read(payload: bytes | memoryview) -> GeometryParameters:
        """Parses the unit.

        Raises:
            FormatError: damaged, or a tool that this decoder lacks.
        """
        r = BitReader(payload, "the geometry parameter set")
        identity, sequence, present = r.u(4), r.u(4), r.flag()
        fields: dict[str, Any] = {"box_log2_scale": 0 if present else r.ue(), "unique_points": r.flag()}
        predictive = r.flag()
        if not predictive:
            fields |= _read_tree_tools(r)
        refuse(r.flag(), "the angular mode")
        if r.flag():
            fields |= {"scaling": True, "base_qp": r.ue(), "qp_shift": r.u(2)}
            if predictive:
                fields["qp_interval_log2"] = r.ue()
            elif fields["direct_mode"]:
                fields["direct_qp_offset"] = r.se()
        refuse(r.flag(), "an extension of the geometry parameter set (trisoup, or a second-edition tool)")
        r.finish()
        parameters = GeometryParameters(
            geometry_id=identity, sequence_id=sequence, box_scale_present=present, predictive=predictive, **fields
        )
        numbers = (parameters.base_qp, abs(parameters.direct_qp_offset), *parameters.plane_thresholds)
        if max(numbers) > 1 << 12 or parameters.qp_interval_log2 > 30:
            raise FormatError("the geometry parameter set holds impossible values")
        return parameters


def _read_tree_tools(r: BitReader) -> dict[str, Any]:
    point_counts, direct_mode = r.flag(), r.u(2)
    direct_pairs = r.flag() if direct_mode else False
    partial_splits, code = r.flag(), r.u(3)
    adjacent, intra = (r.flag(), r.ue()) if code else (False, 0)
    bitwise, planes = r.flag(), r.flag()
    refuse(not bitwise, "bytewise occupancy coding")
    thresholds = (r.ue(), r.ue(), r.ue()) if planes else (0, 0, 0)
    direct_rate = r.u(5) + 1 if planes and direct_mode == 1 else 32
    return {
        "point_counts": point_counts, "direct_mode": direct_mode, "direct_pairs": direct_pairs,
        "partial_splits": partial_splits, "neighbour_boundary": code + 1 if code else 0, "adjacent_child": adjacent,
        "intra_prediction": intra, "planes": planes, "plane_thresholds": thresholds, "direct_rate": direct_rate,
    }  # fmt: skip


@dataclass(frozen=True)
class GeometryHeader:
    """The header (and footer) of a geometry data unit: one slice.

    `axes`: by level of the tree, the axes that it splits: 4 x, 2 y, 1 z. Empty with predictive geometry.
    `previous`: id of the slice whose contexts this one goes on with.
    """

    slice_id: int
    origin: tuple[int, int, int]
    axes: tuple[int, ...]
    points: int
    geometry_id: int = 0
    slice_tag: int = 0
    frame: int = 0
    box_log2_scale: int = 0
    previous: int | None = None
    codewords: int = 1
    qp_offset: int = 0
    qp_interval_delta: int = 0
    residual_bits: tuple[int, int, int] = (0, 0, 0)

    @property
    def size_log2(self) -> tuple[int, int, int]:
        """Logarithms of the extent of the slice's root; of the most that is supported, with predictive geometry."""
        if not self.axes:
            return MAX_DEPTH, MAX_DEPTH, MAX_DEPTH
        x, y, z = (sum(bool(split & 4 >> axis) for split in self.axes) for axis in range(3))
        return x, y, z

    @property
    def depth(self) -> int:
        """Bits of the longest side."""
        return max(self.size_log2)

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
        w.ue(len(self.axes) - 1)
        if geometry.partial_splits:
            for split in self.axes:
                w.u(3, split)
        w.ue(0)  # one arithmetic codeword
        if geometry.scaling:
            w.se(self.qp_offset)
        return w.data()

    def footer(self) -> bytes:
        """The last bytes of the unit."""
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
        r = BitReader(view[: GeometryLimits.header_bytes], "the header of a geometry data unit")
        identity = r.u(4)
        r.u(3)
        slice_id, tag, frame = r.ue(), r.u(sequence.slice_tag_bits), r.u(sequence.frame_counter_bits)
        previous = r.ue() if sequence.entropy_continuation and r.flag() else None
        scale = r.ue() if geometry.box_scale_present else geometry.box_log2_scale
        bits = r.ue() + 1
        if bits > 32 or scale > 32:
            raise FormatError(f"slice {slice_id}: impossible origin in the header")
        origin = (r.u(bits), r.u(bits), r.u(bits))
        axes, codewords = ((), 1) if geometry.predictive else _read_levels(r, slice_id, geometry)
        qp_offset = r.se() if geometry.scaling else 0
        qp_delta = r.se() if geometry.scaling and geometry.predictive else 0
        residual_bits = (r.u(3), r.u(3), r.u(3)) if geometry.predictive else (0, 0, 0)
        r.align()
        footer = FOOTER_BYTES * (len(axes) if geometry.point_counts else 1)
        body = view[:-footer]
        if len(body) < r.byte_position:
            raise FormatError(f"slice {slice_id}: the geometry data unit ends early")
        points = int.from_bytes(view[-FOOTER_BYTES:], "big") + 1
        header = GeometryHeader(
            slice_id, origin, axes, points, identity, tag, frame, scale, previous, codewords, qp_offset, qp_delta,
            residual_bits,
        )  # fmt: skip
        _check(header)
        return header, body[r.byte_position :]


def _read_levels(r: BitReader, slice_id: int, geometry: GeometryParameters) -> tuple[tuple[int, ...], int]:
    """Axes that are split, by level, and the number of arithmetic codewords."""
    levels = r.ue() + 1
    if levels > MAX_LEVELS:
        raise FormatError(f"slice {slice_id}: a tree of {levels} levels; {MAX_LEVELS} are supported")
    axes = tuple(r.u(3) for _ in range(levels)) if geometry.partial_splits else (ALL_AXES,) * levels
    codewords = r.ue() + 1
    if 0 in axes or codewords > levels:
        raise FormatError(f"slice {slice_id}: a tree that cannot be")
    return axes, codewords


def _check(header: GeometryHeader) -> None:
    number = header.slice_id
    if header.depth > MAX_DEPTH:
        raise FormatError(f"slice {number}: an octree of {header.depth} levels; {MAX_DEPTH} are supported")
    if max(header.grid_origin) + (1 << header.depth) > 1 << 31:
        raise FormatError(f"slice {number} lies outside the range of 31-bit positions")
    if abs(header.qp_offset) > 1 << 12 or abs(header.qp_interval_delta) > 30:
        raise FormatError(f"slice {number}: impossible quantiser in the header")
