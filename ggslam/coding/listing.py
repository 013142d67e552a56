# SPDX-License-Identifier: Apache-2.0
"""What a G-PCC stream is made of, unit by unit; payloads are not decoded.

Units of streams that this decoder cannot decode are listed, too, as far as they can be read.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from ggslam.coding.attribute_syntax import LIFTING, PREDICTING, RAHT, RAW, AttributeHeader, AttributeParameters
from ggslam.coding.container import HEADER, Unit, UnitType, read_units
from ggslam.coding.geometry_syntax import GeometryHeader, GeometryParameters
from ggslam.coding.sequence_parameters import (
    MATRIX_BT709,
    MATRIX_IDENTITY,
    MATRIX_YCGCO,
    AttributeDescription,
    SequenceParameters,
)
from ggslam.coding.user_data import read_user_data
from ggslam.errors import FormatError
from ggslam.system.plurals import quantity

_MATRICES = {MATRIX_IDENTITY: " as G, B, R", MATRIX_BT709: " as Y, Cb, Cr (BT.709)", MATRIX_YCGCO: " as Y, Cg, Co"}
_ENCODINGS = {RAHT: "RAHT", PREDICTING: "predicting transform", LIFTING: "lifting transform", RAW: "raw values"}
_PROFILES = ("simple", "dense", "predictive", "main")


@dataclass(frozen=True)
class UnitLine:
    """One unit.

    Attributes:
        offset: of its first byte in the stream.
        kind: what it holds, in words.
        size: bytes, header included.
        points: of the slice that it belongs to; 0: of none.
        fields: its main fields, in words.
    """

    offset: int
    kind: str
    size: int
    points: int
    fields: str

    @property
    def bits_per_point(self) -> float | None:
        """Of its slice."""
        return 8 * self.size / self.points if self.points else None


@dataclass
class StreamListing:
    """All units of a stream.

    Attributes:
        units: in order.
        points: of all slices together.
        slices: how many there are.
        parts: bytes of "geometry", of each attribute by name, and of "headers" (everything else).
        problems: why units could not be read, or where the stream is damaged.
    """

    units: list[UnitLine] = field(default_factory=list)
    points: int = 0
    slices: int = 0
    parts: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)


def list_units(data: bytes | memoryview) -> StreamListing:
    """Reads the headers of all units. Damage is listed, not raised; the listing ends where no further unit is found."""
    lister = _Lister()
    try:
        for unit in read_units(data):
            lister.add(unit)
    except FormatError as error:
        lister.listing.problems.append(str(error))
    return lister.listing


class _Lister:
    """Knows the parameter sets seen so far, which the headers of the units after them depend on."""

    def __init__(self) -> None:
        self.listing = StreamListing()
        self._sequence: SequenceParameters | None = None
        self._geometry: dict[int, GeometryParameters] = {}
        self._attributes: dict[int, AttributeParameters] = {}
        self._names: list[str] = []
        self._slice_points = 0

    def add(self, unit: Unit) -> None:
        """Lists one unit."""
        points, part = 0, "headers"
        try:
            if unit.kind == UnitType.GEOMETRY:
                text, points = self._geometry_unit(unit)
                part = "geometry"
            elif unit.kind == UnitType.ATTRIBUTE:
                text, part = self._attribute_unit(unit)
                points = self._slice_points
            else:
                text = self._other(unit)
        except FormatError as error:
            text = f"cannot be read: {error}"
            self.listing.problems.append(f"{unit.kind.title} unit at byte {unit.offset}: {error}")
        self.listing.units.append(UnitLine(unit.offset, unit.kind.title, unit.size, points, text))
        self.listing.parts[part] += unit.size

    def _other(self, unit: Unit) -> str:
        if unit.kind == UnitType.SEQUENCE_PARAMETERS:
            self._sequence = SequenceParameters.read(unit.payload)
            self._names = [_label(attribute) for attribute in self._sequence.attributes]
            return _sequence_text(self._sequence)
        if unit.kind == UnitType.GEOMETRY_PARAMETERS:
            geometry = GeometryParameters.read(unit.payload)
            self._geometry[geometry.geometry_id] = geometry
            return _geometry_text(geometry)
        if unit.kind == UnitType.ATTRIBUTE_PARAMETERS:
            attribute = AttributeParameters.read(unit.payload)
            self._attributes[attribute.attribute_id] = attribute
            return _attribute_text(attribute)
        if unit.kind == UnitType.USER_DATA:
            return self._user_data(unit)
        return f"{unit.size - HEADER.size} bytes"

    def _user_data(self, unit: Unit) -> str:
        content = read_user_data(unit.payload)
        names = content.get("names")
        if isinstance(names, list) and len(names) == len(self._names):
            self._names = [str(name) for name in names]
        return ", ".join(content) if content else "of another program"

    def _geometry_unit(self, unit: Unit) -> tuple[str, int]:
        if self._sequence is None:
            raise FormatError("there is no sequence parameter set before it")
        identity = GeometryHeader.parameter_set_of(unit.payload)
        if identity not in self._geometry:
            raise FormatError(f"there is no geometry parameter set {identity} before it")
        header, _ = GeometryHeader.read(unit.payload, self._sequence, self._geometry[identity])
        self._slice_points = header.points
        self.listing.points += header.points
        self.listing.slices += 1
        corner = " ".join(str(v) for v in header.grid_origin)
        where = "" if not header.axes else f" in a cube of 2^{header.depth} voxels"
        return f"slice {header.slice_id}: {quantity(header.points, 'point')}{where} at {corner}", header.points

    def _attribute_unit(self, unit: Unit) -> tuple[str, str]:
        if self._sequence is None:
            raise FormatError("there is no sequence parameter set before it")
        identity = AttributeHeader.parameter_set_of(unit.payload)
        if identity not in self._attributes:
            raise FormatError(f"there is no attribute parameter set {identity} before it")
        index = AttributeHeader.attribute_of(unit.payload)
        if index >= len(self._names):
            raise FormatError(f"it is of attribute {index}, the stream has {len(self._names)}")
        components = self._sequence.attributes[index].components
        header, _ = AttributeHeader.read(unit.payload, self._attributes[identity], components)
        depth = self._sequence.attributes[header.attribute].bit_depth
        first, others = self._attributes[identity].qps(depth, header.qp_deltas)
        name = self._names[header.attribute]
        qp = f"QP {first}" if first == others else f"QP {first}, {others}"
        return f"slice {header.slice_id}: {name}, {qp}", name


def _label(attribute: AttributeDescription) -> str:
    return attribute.label + (f"_{attribute.instance}" if attribute.instance else "")


def _sequence_text(s: SequenceParameters) -> str:
    profiles = [name for name, used in zip(_PROFILES, s.profiles, strict=True) if used]
    parts = [f"profile {' '.join(profiles)}, level {s.level}"]
    if s.size is not None:
        parts.append("grid " + "x".join(str(v) for v in s.size))
    offset = " ".join(str(v << s.offset_log2_scale) for v in s.offset)
    parts.append(f"at {offset}, {float(s.resolution):g} voxels a {'metre' if s.metres else 'unit'}")
    for a in s.attributes:
        matrix = _MATRICES.get(a.matrix, "") if a.matrix is not None else ""
        parts.append(f"{_label(a)}: {a.components} x {a.bit_depth} bits{matrix}")
    return "; ".join(parts)


def _geometry_text(g: GeometryParameters) -> str:
    duplicates = "no duplicate points" if g.unique_points else "duplicate points"
    if g.predictive:
        return f"predictive geometry, {duplicates}"
    parts = ["octree", duplicates]
    if g.neighbour_boundary:
        parts.append(f"contexts from neighbours in cubes of 2^{g.neighbour_boundary}")
        parts += ["and from adjacent children"] if g.adjacent_child else []
        parts += [f"prediction of nodes below 2^{g.intra_prediction}"] if g.intra_prediction else []
    else:
        parts.append("contexts from siblings")
    parts += ["planes"] if g.planes else []
    parts += ["levels split some axes only"] if g.partial_splits else []
    parts += [f"direct points (mode {g.direct_mode})"] if g.direct_mode else []
    parts += [f"positions scaled with QP {g.base_qp}"] if g.scaling else []
    return ", ".join(parts)


def _attribute_text(a: AttributeParameters) -> str:
    parts = [f"set {a.attribute_id}: {_ENCODINGS[a.encoding]}"]
    if a.encoding != RAW:
        parts += [f"QP {a.qp}", f"chroma offset {a.chroma_offset}"]
    if a.encoding == RAHT:
        thresholds = f"prediction with thresholds {a.thresholds[0]} {a.thresholds[1]}"
        parts.append(thresholds if a.prediction else "no prediction")
    elif a.encoding != RAW:
        parts.append(f"levels of detail: {a.details.levels}")
    return ", ".join(parts)
