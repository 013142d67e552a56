# SPDX-License-Identifier: Apache-2.0
"""Attribute parameter sets and the headers of attribute data units (ISO/IEC 23090-9, first edition).

Reading stops with a FormatError that names the first tool which this decoder lacks.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from ggslam.coding.bits import BitReader, BitWriter
from ggslam.coding.geometry_syntax import refuse
from ggslam.errors import FormatError
from ggslam.system.tuning import Tuning

MAX_PARAMETER_SETS: Final = 16
"""Attribute parameter sets of a stream: their ids have 4 bits."""
RAHT: Final = 0
"""Number of the region-adaptive hierarchical transform."""
PREDICTING: Final = 1
"""Number of the predicting transform."""
LIFTING: Final = 2
"""Number of the lifting transform."""
RAW: Final = 3
"""Number of values that are stored as they are."""


class AttributeLimits(Tuning):
    """Limits on hostile streams."""

    max_detail_levels = 32
    """Most levels of detail."""
    header_bytes = 1 << 10
    """Bytes of an attribute data unit that its header is read from; no valid header is longer."""


_BY_DISTANCE: Final = 0
"""Number of decimation by distance."""


@dataclass(frozen=True)
class DetailSettings:
    """How the predicting and the lifting transform order points by levels of detail and find their neighbours.

    `decimation`: 0 by distance, 1 every n-th point, 2 by octree cubes; `periods`: n of each level.
    `skip_layers`: levels, from the finest, whose points are not predicted from points of their own level.
    """

    neighbours: int = 3
    search_between: int = 0
    bias: tuple[int, int, int] = (1, 1, 1)
    levels: int = 1
    canonical_order: bool = False
    decimation: int = _BY_DISTANCE
    periods: tuple[int, ...] = ()
    first_distance: int = 0
    distance_deltas: bool = False
    last_component: bool = False
    direct_predictors: int = 0
    direct_threshold: int = 0
    no_average: bool = False
    search_within: int = 0
    skip_layers: int = 1 << 30
    between_components: bool = False
    blend: bool = False


@dataclass(frozen=True)
class AttributeParameters:
    """The attribute parameter set. `thresholds` and `prediction` belong to the region-adaptive hierarchical transform,
    `details` to the predicting and the lifting transform, `variable_length` to raw attributes."""

    qp: int
    chroma_offset: int = 0
    prediction: bool = True
    thresholds: tuple[int, int] = (2, 6)
    slice_qp_deltas: bool = False
    attribute_id: int = 0
    sequence_id: int = 0
    encoding: int = RAHT
    details: DetailSettings = field(default_factory=DetailSettings)
    variable_length: bool = False

    def write(self) -> bytes:
        """The payload of the unit, of the region-adaptive hierarchical transform."""
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
        """Parses the unit.

        Raises:
            FormatError: damaged, or a tool that this decoder lacks.
        """
        r = BitReader(payload, "an attribute parameter set")
        identity, sequence, encoding = r.u(4), r.u(4), r.ue()
        refuse(encoding > RAW, f"attribute coding of the unknown kind {encoding}")
        qp, chroma, deltas = r.ue() + 4, r.se(), r.flag()
        details = _read_details(r, encoding) if encoding in (PREDICTING, LIFTING) else DetailSettings()
        prediction, thresholds = False, (0, 0)
        if encoding == RAHT:
            prediction = r.flag()
            thresholds = (r.ue(), r.ue()) if prediction else (0, 0)
        variable_length = r.flag() if encoding == RAW else False
        refuse(r.flag(), "attribute coding in spherical coordinates")
        refuse(r.flag(), "an extension of an attribute parameter set (a second-edition tool)")
        r.finish()
        if qp > 99 or abs(chroma) > 99 or max(thresholds) > 255:
            raise FormatError("an attribute parameter set holds impossible values")
        return AttributeParameters(
            qp, chroma, prediction, thresholds, deltas, identity, sequence, encoding, details, variable_length
        )

    def qps(self, bit_depth: int, deltas: tuple[int, int] = (0, 0)) -> tuple[int, int]:
        """Quantiser parameters of component 0 and of the others, after a slice's deltas."""
        highest = highest_qp(bit_depth)
        first = min(max(self.qp + deltas[0], 4), highest)
        return first, min(max(first + self.chroma_offset + deltas[1], 4), highest)


def highest_qp(bit_depth: int) -> int:
    """The largest quantiser parameter of values of so many bits."""
    return 51 + 6 * max(0, bit_depth - 8)


def _read_details(r: BitReader, encoding: int) -> DetailSettings:
    neighbours, between = r.ue() + 1, r.ue()
    bias = (r.ue() + 1, r.ue() + 1, r.ue() + 1)
    last_component = r.flag() if encoding == LIFTING else False
    refuse(r.flag(), "scalable lifting")
    levels = r.ue() + 1
    periods: tuple[int, ...] = ()
    canonical, decimation, distance, distance_deltas = False, _BY_DISTANCE, 0, False
    if levels > AttributeLimits.max_detail_levels:
        raise FormatError(f"an attribute parameter set with {levels} levels of detail")
    if levels == 1:
        canonical = r.flag()
    else:
        decimation = r.ue()
        if decimation != _BY_DISTANCE:
            periods = tuple(r.ue() + 2 for _ in range(levels - 1))
        distance, distance_deltas = r.ue(), r.flag()
    direct, threshold, no_average, within, skip, components, blend = 0, 0, False, 0, 1 << 30, False, False
    if encoding == PREDICTING:
        direct = r.ue()
        if direct:
            threshold, no_average = r.u(8), r.flag()
        within = r.ue()
        if within:
            skip = r.ue()
        components, blend = r.flag(), r.flag()
    impossible = neighbours > 3 or direct > 3 or distance > 21 or decimation > 2
    if impossible or max(*bias, *periods, 0) > 1 << 20 or max(between, within) >> 30:
        raise FormatError("an attribute parameter set holds impossible values")
    return DetailSettings(
        neighbours, between, bias, levels, canonical, decimation, periods, distance, distance_deltas, last_component,
        direct, threshold, no_average, within, skip, components, blend,
    )  # fmt: skip


@dataclass(frozen=True)
class AttributeHeader:
    """The header of an attribute data unit.

    `component_weights`: by level of detail from the coarsest, what components 1 and 2 take over from component 0 (with
    lifting: component 2 from component 1), in quarters. `layer_deltas`: quantiser offsets by level.
    """

    slice_id: int
    attribute: int = 0
    attribute_id: int = 0
    qp_deltas: tuple[int, int] = (0, 0)
    distance_delta: int = 0
    component_weights: tuple[tuple[int, int], ...] = ()
    layer_deltas: tuple[tuple[int, int], ...] = ()

    def write(self, parameters: AttributeParameters) -> bytes:
        """The header; the payload follows it."""
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
    def attribute_of(payload: bytes | memoryview) -> int:
        """Index of the attribute that a unit is of."""
        r = BitReader(payload[:8], "an attribute data unit")
        r.u(7)
        return r.ue()

    @staticmethod
    def read(
        payload: bytes | memoryview, parameters: AttributeParameters, components: int = 3
    ) -> tuple[AttributeHeader, memoryview]:
        """The header, and the arithmetic payload after it.

        Args:
            components: of the attribute, on which the syntax depends.
        """
        r = BitReader(payload[: AttributeLimits.header_bytes], "the header of an attribute data unit")
        identity = r.u(4)
        r.u(3)
        attribute, slice_id = r.ue(), r.ue()
        details = parameters.details
        distance_delta = r.se() if details.distance_deltas else 0
        weights = _read_component_weights(r, parameters) if components == 3 else ()
        deltas = (r.se(), r.se()) if parameters.slice_qp_deltas else (0, 0)
        layers: tuple[tuple[int, int], ...] = ()
        if r.flag():
            count = r.ue() + 1
            if count > AttributeLimits.max_detail_levels:
                raise FormatError(f"slice {slice_id}: quantiser offsets of {count} levels")
            layers = tuple((r.se(), r.se()) for _ in range(count))
        refuse(r.ue() != 0, "quantiser offsets by region")
        r.align()
        numbers = [*deltas, distance_delta, *(v for pair in (*weights, *layers) for v in pair)]
        if max(map(abs, numbers)) > 127 or not 0 <= details.first_distance + distance_delta <= 21:
            raise FormatError(f"slice {slice_id}: impossible offsets in the header of an attribute")
        header = AttributeHeader(slice_id, attribute, identity, deltas, distance_delta, weights, layers)
        return header, memoryview(payload)[r.byte_position :]


def _read_component_weights(r: BitReader, parameters: AttributeParameters) -> tuple[tuple[int, int], ...]:
    details = parameters.details
    out: list[tuple[int, int]] = []
    first, second = 4, 4
    if parameters.encoding == LIFTING and details.last_component:
        for _ in range(details.levels):
            second += r.se()
            out.append((0, second))
    elif parameters.encoding == PREDICTING and details.between_components:
        for _ in range(details.levels):
            first, second = first + r.se(), second + r.se()
            out.append((first, second))
    return tuple(out)
