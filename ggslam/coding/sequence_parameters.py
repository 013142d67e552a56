# SPDX-License-Identifier: Apache-2.0
"""The sequence parameter set (ISO/IEC 23090-9, first edition): profile, coordinate system, list of attributes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Final

from ggslam.coding.bits import BitReader, BitWriter
from ggslam.errors import FormatError
from ggslam.system.tuning import Tuning

KNOWN_LABELS = ("color", "reflectance", "opacity", "frame_index", "frame_number", "material", "normal")


class SequenceLimits(Tuning):
    """A limit on hostile streams."""

    max_attributes = 255
    """Most attributes of a stream."""


CICP_PARAMETER: Final = 2
"""Number of the attribute parameter that tells the colour matrix."""
SCALING_PARAMETER: Final = 3
"""Number of the attribute parameter that tells offset and scale."""
MATRIX_IDENTITY: Final = 0
"""Colour matrix G, B, R (ISO/IEC 23091-2)."""
MATRIX_BT709: Final = 1
"""Colour matrix of BT.709."""
MATRIX_YCGCO: Final = 8
"""Colour matrix YCgCo."""
AXIS_ORDERS: Final = ((2, 1, 0), (0, 1, 2), (0, 2, 1), (2, 0, 1), (2, 1, 0), (1, 2, 0), (1, 0, 2), (0, 1, 2))
"""Which of the coded axes are x, y and z, by the number in the stream."""
_SECOND_EDITION = "a damaged stream, or one of a draft of the second edition, which is not supported"


@dataclass(frozen=True)
class AttributeDescription:
    """One attribute as the sequence parameter set lists it.

    `matrix` is the colour matrix (ISO/IEC 23091-2): 0 components are G, B, R; 1 BT.709 Y, Cb, Cr; 8 Y, Cg, Co without
    loss (the bit depth is one more than the colours'); None: not said.
    A value is offset + (coded scale >> fraction_bits).
    """

    label: str
    components: int
    bit_depth: int
    instance: int = 0
    matrix: int | None = None
    full_range: bool = True
    offset: int = 0
    scale: int = 1
    fraction_bits: int = 0

    @property
    def has_scale(self) -> bool:
        """Whether values differ from what is coded."""
        return (self.offset, self.scale, self.fraction_bits) != (0, 1, 0)

    def reach(self) -> tuple[int, int]:
        """Lowest and highest value."""
        return self.offset, self.offset + (((1 << self.bit_depth) - 1) * self.scale >> self.fraction_bits)


@dataclass(frozen=True)
class SequenceParameters:
    """The sequence parameter set.

    A point of the grid stands at (grid + offset 2^offset_log2_scale) / resolution, in metres if `metres`.
    """

    attributes: tuple[AttributeDescription, ...] = ()
    unique_points: bool = False
    offset: tuple[int, int, int] = (0, 0, 0)
    offset_log2_scale: int = 0
    size: tuple[int, int, int] | None = None
    resolution: Fraction = field(default_factory=lambda: Fraction(1))
    metres: bool = False
    global_scale: Fraction = field(default_factory=lambda: Fraction(1))
    sequence_id: int = 0
    level: int = 120
    profiles: tuple[bool, bool, bool, bool] = (False, False, False, True)
    frame_counter_bits: int = 0
    slice_tag_bits: int = 0
    cabac_bypass_stream: bool = False
    entropy_continuation: bool = False
    axis_order: int = 1

    @property
    def axes(self) -> tuple[int, int, int]:
        """Which of the coded axes are x, y and z."""
        return AXIS_ORDERS[self.axis_order]

    def write(self) -> bytes:
        """The payload of the unit. The axes are coded in the order x, y, z; the global scale is 1."""
        w = BitWriter()
        for profile in self.profiles:
            w.flag(profile)
        w.u(18, 0)
        w.flag(False)  # slices may come in any order
        w.flag(self.unique_points)
        w.u(8, self.level)
        w.u(4, self.sequence_id)
        w.u(5, self.frame_counter_bits)
        w.u(5, self.slice_tag_bits)
        self._write_box(w)
        w.ue(self.resolution.numerator - 1)
        w.ue(self.resolution.denominator - 1)
        w.flag(self.metres)
        w.ue(0)
        w.ue(0)
        w.ue(len(self.attributes))
        for attribute in self.attributes:
            _write_attribute(w, attribute)
        w.u(3, 1)
        w.flag(self.cabac_bypass_stream)
        w.flag(self.entropy_continuation)
        w.flag(False)
        return w.data()

    def _write_box(self, w: BitWriter) -> None:
        bits = max(1, max(abs(v).bit_length() for v in self.offset))
        w.ue(bits)
        for v in self.offset:
            w.s(bits, v)
        w.ue(self.offset_log2_scale)
        if self.size is None:
            w.ue(0)
            return
        bits = max(1, max((v - 1).bit_length() for v in self.size))
        w.ue(bits)
        for v in self.size:
            w.u(bits, v - 1)

    @staticmethod
    def read(payload: bytes | memoryview) -> SequenceParameters:
        """Parses the unit.

        Raises:
            FormatError: damaged, or a tool that this decoder lacks.
        """
        r = BitReader(payload, "the sequence parameter set")
        profiles = (r.flag(), r.flag(), r.flag(), r.flag())
        if r.u(18) != 0 or not any(profiles):
            raise FormatError(f"the sequence parameter set names no profile of the first edition: {_SECOND_EDITION}")
        r.flag()
        unique, level = r.flag(), r.u(8)
        identity, frame_bits, tag_bits = r.u(4), r.u(5), r.u(5)
        offset, offset_scale, size = _read_box(r)
        numerator, denominator = r.ue() + 1, r.ue() + 1
        metres = r.flag()
        global_scale = _read_global_scale(r)
        count = r.ue()
        if count > SequenceLimits.max_attributes:
            raise FormatError(f"the sequence parameter set lists {count} attributes: {_SECOND_EDITION}")
        parameters = SequenceParameters(
            tuple(_read_attribute(r) for _ in range(count)), unique, offset, offset_scale, size,
            Fraction(numerator, denominator), metres, global_scale, identity, level, profiles, frame_bits, tag_bits,
        )  # fmt: skip
        axes = r.u(3)
        parameters = replace(
            parameters, axis_order=axes, cabac_bypass_stream=r.flag(), entropy_continuation=r.flag()
        )
        extension = r.flag()
        if extension:
            raise FormatError("the sequence parameter set has an extension, which is not supported")
        r.finish()
        return parameters


def _read_box(r: BitReader) -> tuple[tuple[int, int, int], int, tuple[int, int, int] | None]:
    bits = r.ue()
    offset, scale = (0, 0, 0), 0
    if bits > 64:
        raise FormatError(f"the sequence parameter set has a box offset of {bits} bits: {_SECOND_EDITION}")
    if bits:
        offset, scale = (r.s(bits), r.s(bits), r.s(bits)), r.ue()
        if scale > 32:
            raise FormatError(f"the sequence parameter set scales its box by 2^{scale}: {_SECOND_EDITION}")
    bits = r.ue()
    if bits > 64:
        raise FormatError(f"the sequence parameter set has a box size of {bits} bits: {_SECOND_EDITION}")
    return offset, scale, (r.u(bits) + 1, r.u(bits) + 1, r.u(bits) + 1) if bits else None


def _read_global_scale(r: BitReader) -> Fraction:
    shift, bits = r.ue(), r.ue()
    if shift > 32 or bits > 32:
        raise FormatError(f"the sequence parameter set has an impossible global scale: {_SECOND_EDITION}")
    return Fraction((1 << bits) + r.u(bits), 1 << bits) * (1 << shift)


def _write_attribute(w: BitWriter, attribute: AttributeDescription) -> None:
    w.ue(attribute.components - 1)
    w.ue(attribute.instance)
    w.ue(attribute.bit_depth - 1)
    w.flag(True)
    w.ue(KNOWN_LABELS.index(attribute.label))
    w.ue((attribute.matrix is not None) + attribute.has_scale)
    w.align()
    if attribute.matrix is not None:
        body = BitWriter()
        body.ue(2)  # colour primaries and transfer characteristics: unspecified
        body.ue(2)
        body.ue(attribute.matrix)
        body.flag(attribute.full_range)
        _write_parameter(w, CICP_PARAMETER, body)
    if attribute.has_scale:
        body = BitWriter()
        for value, sign in ((attribute.offset, True), (attribute.scale - 1, False)):
            bits = abs(value).bit_length()
            body.ue(bits)
            body.s(bits, value) if sign else body.u(bits, value)
        body.ue(attribute.fraction_bits)
        _write_parameter(w, SCALING_PARAMETER, body)


def _write_parameter(w: BitWriter, kind: int, body: BitWriter) -> None:
    data = body.data()
    w.u(8, kind)
    w.u(8, len(data))
    for byte in data:
        w.u(8, byte)


def _read_attribute(r: BitReader) -> AttributeDescription:
    components, instance, bit_depth = r.ue() + 1, r.ue(), r.ue() + 1
    if not r.flag():
        raise FormatError("an attribute is labelled by an object identifier, which is not supported")
    label, count = r.ue(), r.ue()
    if label >= len(KNOWN_LABELS):
        raise FormatError(f"an attribute has the unknown label {label}: {_SECOND_EDITION}")
    name = KNOWN_LABELS[label]
    if components not in (1, 3) or not 1 <= bit_depth <= 16:
        raise FormatError(f"attribute {name}: {components} components of {bit_depth} bits, not 1 or 3 of 1 to 16")
    if count > 255:
        raise FormatError(f"attribute {name} has {count} parameters: {_SECOND_EDITION}")
    r.align()
    description = AttributeDescription(name, components, bit_depth, instance)
    for _ in range(count):
        kind = r.u(8)
        body = bytes(r.u(8) for _ in range(r.u(8)))
        if kind == CICP_PARAMETER:
            matrix, full_range = _read_cicp(body)
            description = replace(description, matrix=matrix, full_range=full_range)
        elif kind == SCALING_PARAMETER:
            offset, scale, fraction_bits = _read_scaling(body)
            description = replace(description, offset=offset, scale=scale, fraction_bits=fraction_bits)
    return description


def _read_cicp(body: bytes) -> tuple[int, bool]:
    r = BitReader(body, "the colour description of an attribute")
    r.ue()
    r.ue()
    matrix, full_range = r.ue(), r.flag()
    r.finish()
    return matrix, full_range


def _read_scaling(body: bytes) -> tuple[int, int, int]:
    """Offset, scale, bits of the fraction."""
    r = BitReader(body, "the scale of an attribute")
    bits = r.ue()
    offset = r.s(bits) if bits <= 31 else 1 << 31
    bits = r.ue()
    scale = 1 + r.u(bits) if bits <= 31 else 1 << 31
    fraction_bits = r.ue()
    r.finish()
    if max(abs(offset), scale) > 1 << 30 or fraction_bits > 30:
        raise FormatError(f"an attribute has an impossible scale: {_SECOND_EDITION}")
    return offset, scale, fraction_bits
