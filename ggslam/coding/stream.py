# SPDX-License-Identifier: Apache-2.0
"""A coded stream taken apart: parameter sets, slices and what was said beside them. Payloads are not decoded."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from ggslam.coding.attribute_syntax import AttributeHeader, AttributeParameters
from ggslam.coding.attribute_values import ID_BITS, CodedAttribute, IdTable
from ggslam.coding.container import Unit, UnitType, read_units
from ggslam.coding.geometry_syntax import GeometryHeader, GeometryParameters
from ggslam.coding.native_settings import AttributePayload, CodingContext
from ggslam.coding.quantization import Quantization
from ggslam.coding.sequence_parameters import MATRIX_BT709, MATRIX_IDENTITY, MATRIX_YCGCO, SequenceParameters
from ggslam.coding.slice_coder import MAX_SLICE_POINTS
from ggslam.coding.user_data import read_user_data, version_of
from ggslam.errors import FormatError
from ggslam.system.tuning import Tuning


class StreamLimits(Tuning):
    """Limits on hostile streams."""

    free_points = 1 << 20
    """Points that a stream of any size may claim; they may be duplicates."""
    points_per_byte = 1536
    """Points per byte beyond them: an adaptive bin costs at least 0.0056 bits and a point at least one bin, so that a
    byte holds at most 1,431."""


_UNSPECIFIED: Final = 2
"""Colour matrix that is not said (ISO/IEC 23091-2)."""


@dataclass
class CodedSliceUnits:
    """The units of one slice."""

    header: GeometryHeader
    geometry: GeometryParameters
    payload: memoryview
    attributes: dict[int, AttributePayload] = field(default_factory=dict)
    corrections: dict[str, Any] = field(default_factory=dict)
    size: int = 0


@dataclass
class CodedStream:
    """A stream's parameter sets and slices."""

    sequence: SequenceParameters
    slices: list[CodedSliceUnits]
    side: dict[str, Any]
    attributes: list[CodedAttribute]
    quantization: Quantization
    context: CodingContext

    @property
    def first_version(self) -> bool:
        """Whether the first version of this codec wrote it."""
        return self.context.first_version


class _Parser:
    def __init__(self) -> None:
        self.sequence: SequenceParameters | None = None
        self.geometry: dict[int, GeometryParameters] = {}
        self.attribute: dict[int, AttributeParameters] = {}
        self.slices: list[CodedSliceUnits] = []
        self.side: dict[str, Any] = {}
        self.version: int | None = None

    def unit(self, unit: Unit) -> None:
        kind = unit.kind
        if kind == UnitType.SEQUENCE_PARAMETERS:
            if self.slices:
                raise FormatError("a second sequence begins within the stream, which is not supported")
            self.sequence = SequenceParameters.read(unit.payload)
        elif kind == UnitType.GEOMETRY_PARAMETERS:
            geometry = GeometryParameters.read(unit.payload)
            self.geometry[geometry.geometry_id] = geometry
        elif kind == UnitType.ATTRIBUTE_PARAMETERS:
            attribute = AttributeParameters.read(unit.payload)
            self.attribute[attribute.attribute_id] = attribute
        elif kind == UnitType.GEOMETRY:
            self._geometry_unit(unit)
        elif kind == UnitType.ATTRIBUTE:
            self._attribute_unit(unit)
        elif kind == UnitType.USER_DATA:
            self._user_data(unit)
        elif kind in (UnitType.CONSTANT_ATTRIBUTE, UnitType.ATTRIBUTE_PARAMETER_INVENTORY):
            raise FormatError(f"the stream has a {kind.title} unit, which is not supported")
        # Tile inventories say which slices belong together, frame boundaries that a frame ends: neither is needed.

    def _geometry_unit(self, unit: Unit) -> None:
        if self.sequence is None:
            raise FormatError("a slice comes before the sequence parameter set")
        identity = GeometryHeader.parameter_set_of(unit.payload)
        if identity not in self.geometry:
            raise FormatError(f"a slice refers to geometry parameter set {identity}, which the stream lacks")
        geometry = self.geometry[identity]
        header, payload = GeometryHeader.read(unit.payload, self.sequence, geometry)
        if self.slices and header.frame != self.slices[0].header.frame:
            raise FormatError("the stream holds several frames, which is not supported")
        if header.points > MAX_SLICE_POINTS:
            raise FormatError(f"slice {header.slice_id}: {header.points} points")
        self.slices.append(CodedSliceUnits(header, geometry, payload, size=unit.size))

    def _attribute_unit(self, unit: Unit) -> None:
        if not self.slices or self.sequence is None:
            raise FormatError("an attribute comes before the geometry of its slice")
        identity = AttributeHeader.parameter_set_of(unit.payload)
        if identity not in self.attribute:
            raise FormatError(f"an attribute refers to parameter set {identity}, which the stream lacks")
        parameters = self.attribute[identity]
        index = AttributeHeader.attribute_of(unit.payload)
        if index >= len(self.sequence.attributes):
            raise FormatError(f"an attribute {index} too many: the stream has {len(self.sequence.attributes)}")
        header, payload = AttributeHeader.read(unit.payload, parameters, self.sequence.attributes[index].components)
        current = self.slices[-1]
        if header.slice_id != current.header.slice_id:
            raise FormatError(f"an attribute of slice {header.slice_id} follows slice {current.header.slice_id}")
        if header.attribute in current.attributes:
            raise FormatError(f"slice {header.slice_id} has attribute {header.attribute} twice")
        current.attributes[header.attribute] = AttributePayload(header, parameters, payload)
        current.size += unit.size

    def _user_data(self, unit: Unit) -> None:
        content = read_user_data(unit.payload)
        self.version = version_of(unit.payload) or self.version
        corrections = content.get("corrections")
        if not isinstance(corrections, dict):
            self.side.update(content)
            return
        if not self.slices or content.get("slice") != self.slices[-1].header.slice_id:
            raise FormatError("corrections of ids follow another slice than their own")
        self.slices[-1].corrections = corrections
        self.slices[-1].size += unit.size


def read_stream(data: bytes | memoryview) -> CodedStream:
    """Takes a stream apart.

    Raises:
        FormatError: damaged, no first-edition G-PCC stream, or one with a tool that this decoder lacks (it is named).
    """
    parser = _Parser()
    for unit in read_units(data):
        parser.unit(unit)
    if parser.sequence is None or not parser.slices:
        raise FormatError("the stream holds no slice")
    points = sum(units.header.points for units in parser.slices)
    if points > StreamLimits.free_points + StreamLimits.points_per_byte * len(data):
        raise FormatError(f"a stream of {len(data)} bytes cannot hold {points} points")
    for units in parser.slices:
        missing = set(range(len(parser.sequence.attributes))) - set(units.attributes)
        if missing:
            raise FormatError(f"slice {units.header.slice_id} lacks attribute {min(missing)}")
    attributes = _attributes(parser.sequence, parser.side)
    version = parser.version
    # The reference encoder counts frames in one bit, as this codec does since its second version.
    if version is None and parser.sequence.frame_counter_bits == parser.sequence.slice_tag_bits == 0:
        version = 1
    sequence, quantization = parser.sequence, _quantization(parser.sequence, parser.side)
    context = CodingContext(
        sequence.cabac_bypass_stream, sequence.entropy_continuation, version == 1, sequence.axes
    )
    return CodedStream(sequence, parser.slices, parser.side, attributes, quantization, context)


def _attributes(sequence: SequenceParameters, side: dict[str, Any]) -> list[CodedAttribute]:
    names = side.get("names")
    if not (isinstance(names, list) and len(set(map(str, names))) == len(names) == len(sequence.attributes)):
        names = [d.label + (f"_{d.instance}" if d.instance else "") for d in sequence.attributes]
    tables = side.get("tables")
    result = []
    for index, (name, description) in enumerate(zip(names, sequence.attributes, strict=True)):
        if description.matrix == _UNSPECIFIED:
            description = replace(description, matrix=None)
        known = (None, MATRIX_IDENTITY, MATRIX_BT709, MATRIX_YCGCO)
        if description.matrix not in known and description.components == 3:
            raise FormatError(f"attribute {name} has the colour matrix {description.matrix}, which is not supported")
        if description.matrix == MATRIX_BT709 and (description.components != 3 or description.bit_depth != 8):
            description = replace(description, matrix=None)
        table = tables.get(name) if isinstance(tables, dict) else None
        result.append(CodedAttribute(str(name), index, description, None if table is None else read_table(name, table)))
    return result


def read_table(name: str, content: Any) -> IdTable:
    """The table of ids in a stream's user data: ids as a list, or their number if they are 0, 1, ...; the bits of the
    stride, or in streams of earlier versions the stride of ranks that begin at 0. Raises FormatError if damaged."""
    try:
        told = content["ids"]
        if isinstance(told, int) and not 1 <= told <= 1 << ID_BITS:
            raise ValueError
        ids = np.arange(told, dtype=np.uint16) if isinstance(told, int) else np.asarray(told, np.uint16)
        bits = content.get("bits")
        if bits is not None and not 0 <= int(bits) < ID_BITS:
            raise ValueError
        table = IdTable(ids, int(content["stride"])) if bits is None else IdTable.of_bits(ids, int(bits))
    except (AttributeError, KeyError, ValueError, TypeError, OverflowError):
        raise FormatError(f"the table of the ids of attribute {name} is damaged") from None
    if ids.ndim != 1 or len(ids) == 0 or not 1 <= table.stride <= 65535:
        raise FormatError(f"the table of the ids of attribute {name} is damaged")
    return table


def _quantization(sequence: SequenceParameters, side: dict[str, Any]) -> Quantization:
    scale, centre = side.get("scale"), side.get("centre", 0.0)
    if scale is None:
        scale = float(sequence.resolution)
    if not isinstance(scale, float) or not isinstance(centre, float) or not 0 < scale < 1e300 or abs(centre) > 1:
        raise FormatError("the scale of the positions is damaged")
    x, y, z = (v << sequence.offset_log2_scale for v in sequence.offset)
    unit, shift, metres = 1.0, _numbers(side.get("shift"), "the origin of the positions"), sequence.metres
    metadata = side.get("metadata")
    if isinstance(metadata, dict) and metadata.get("grid") is not None:  # streams of the first version
        unit, shift, metres = *_place(metadata["grid"]), True
    return Quantization(
        scale, (x, y, z), sequence.size, centre, metres, unit, shift, float(sequence.global_scale)
    )  # fmt: skip


def _place(grid: Any) -> tuple[float, tuple[float, float, float]]:
    """Voxel size and origin."""
    what = "the place of the grid in the stream's metadata"
    if not isinstance(grid, dict) or "origin" not in grid:
        raise FormatError(f"{what} is damaged")
    voxel_size = grid.get("voxel_size")
    if not isinstance(voxel_size, (int, float)) or not 1e-12 < voxel_size < 1e12:
        raise FormatError(f"{what} is damaged")
    return float(voxel_size), _numbers(grid["origin"], what)


def _numbers(values: Any, what: str) -> tuple[float, float, float]:
    """Three numbers; zeros for None."""
    if values is None:
        return 0.0, 0.0, 0.0
    try:
        x, y, z = (float(value) for value in values)
    except (TypeError, ValueError, OverflowError):
        raise FormatError(f"{what} is damaged") from None
    if not all(abs(value) < 1e12 for value in (x, y, z)):
        raise FormatError(f"{what} is damaged")
    return x, y, z
