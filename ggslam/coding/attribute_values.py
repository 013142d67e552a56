# SPDX-License-Identifier: Apache-2.0
"""Attributes as the caller has them, and as components for the coder: colour spaces, bit depths, ids.

Ids must come back exactly, which the transform does not promise at any quantiser parameter. They are therefore coded as
their rank in the sorted table of ids (small ids as themselves) times a stride, plus half a stride, with a step well
below the stride: cutting off then undoes the error. The stride is a power of two, which the attribute's scale in the
sequence parameter set tells, so that every decoder cuts off and shows plain ranks. The encoder knows what a decoder
will reconstruct and lists the ranks that come out wrong. Up to some hundred ids there are none; with thousands there
are, as the transform's 15-bit factors let large values shrink by up to a thousandth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from ggslam.coding.attribute_syntax import MAX_PARAMETER_SETS, AttributeParameters, highest_qp
from ggslam.coding.sequence_parameters import (
    KNOWN_LABELS,
    MATRIX_BT709,
    MATRIX_IDENTITY,
    MATRIX_YCGCO,
    AttributeDescription,
    SequenceLimits,
)
from ggslam.coding.settings import AttributeSettings, CodecSettings
from ggslam.coding.slice_coder import rgb_to_ycbcr, ycbcr_to_rgb
from ggslam.errors import ConfigError, FormatError
from ggslam.system.tuning import Tuning

_GBR = [1, 2, 0]  # where G, B, R are in R, G, B
_RGB = [2, 0, 1]  # and back
ID_BITS: Final = 16
"""Bits of an object id."""


class IdTuning(Tuning):
    """When object ids are coded without a table."""

    small_ids = 256
    """Ids below this are coded as they are: the transform restores all of them."""


@dataclass(frozen=True)
class IdTable:
    """The ids of a lossless attribute: ids[rank], coded as start + stride * rank."""

    ids: np.ndarray
    stride: int
    start: int = 0

    @staticmethod
    def of(values: np.ndarray, bits: int = ID_BITS - 1) -> IdTable:
        """The table of ids, with a stride of 2^`bits` at most."""
        ids = np.unique(values).astype(np.uint16)
        if ids[-1] < IdTuning.small_ids:
            ids = np.arange(ids[-1] + 1, dtype=np.uint16)
        return IdTable.of_bits(ids, min(bits, ID_BITS - (len(ids) - 1).bit_length()))

    @staticmethod
    def of_bits(ids: np.ndarray, bits: int) -> IdTable:
        """The table with a stride of 2^`bits`."""
        return IdTable(ids, 1 << bits, 1 << bits >> 1)

    @property
    def bits(self) -> int:
        """Of the stride, a power of two."""
        return self.stride.bit_length() - 1

    @property
    def tells_ids(self) -> bool:
        """Whether ranks are the ids."""
        return int(self.ids[-1]) == len(self.ids) - 1

    def qp(self) -> int:
        """Quantiser parameter of a step at most three tenths of the stride, at least 4 (a step of one)."""
        return int(np.clip(4 + np.floor(6 * np.log2(max(1.0, 0.3 * self.stride))), 4, 99))

    def components(self, values: np.ndarray) -> np.ndarray:
        return (np.searchsorted(self.ids, values) * self.stride + self.start).astype(np.int32)

    def ranks(self, components: np.ndarray) -> np.ndarray:
        return np.clip((components - self.start + self.stride // 2) // self.stride, 0, len(self.ids) - 1)


@dataclass(frozen=True)
class CodedAttribute:
    """One attribute of a stream: its place in the parameter sets, and how components become values."""

    name: str
    index: int
    description: AttributeDescription
    table: IdTable | None = None

    def components(self, values: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Components int32 [M, C] of the values in `rows`, uint32 [M]."""
        if self.description.matrix == MATRIX_BT709:
            return rgb_to_ycbcr(values, rows)
        picked = values[rows].reshape(len(rows), -1)
        if self.table is not None:
            return self.table.components(picked)
        if self.description.has_scale:
            scale = self.description.scale
            picked = (picked.astype(np.int64) - self.description.offset + scale // 2) // scale
        if self.description.matrix == MATRIX_IDENTITY:
            picked = picked[:, _GBR]
        return np.ascontiguousarray(picked, np.int32)

    def merged_components(self, values: np.ndarray, rows: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """The same, with one row for each run of `counts` rows: the mean, or of ids the most frequent one."""
        starts = np.cumsum(counts, dtype=np.int64) - counts
        if self.table is not None:
            return self.components(values, rows[_most_frequent(values.reshape(-1)[rows], starts, counts)])
        sums = np.add.reduceat(values[rows].reshape(len(rows), -1), starts, axis=0, dtype=np.int64)
        means = (2 * sums + counts[:, None]) // (2 * counts[:, None].astype(np.int64))
        return self.components(means.astype(values.dtype), np.arange(len(counts), dtype=np.uint32))

    def values(self, components: np.ndarray, corrections: Mapping[str, Any] | None = None) -> np.ndarray:
        """What the caller sees: uint8, above 8 bits uint16, of values that do not fit int64, [N, 3] or [N].

        Raises:
            FormatError: corrections of ids that are none.
        """
        description = self.description
        if self.table is not None:
            return self._ids(components[:, 0], corrections)
        if description.has_scale:
            components = (components.astype(np.int64) * description.scale >> description.fraction_bits)
            components += description.offset
        if description.matrix == MATRIX_BT709:
            return ycbcr_to_rgb(components.clip(0, 255).astype(np.int32) if description.has_scale else components)
        if description.matrix == MATRIX_YCGCO and description.components == 3:
            return _rgb_of_ycgco(components, description.bit_depth - 1)
        values = components.astype(self.dtype)
        if description.components == 1:
            return values[:, 0]
        return np.ascontiguousarray(values[:, _RGB]) if description.matrix == MATRIX_IDENTITY else values

    @property
    def dtype(self) -> np.dtype:
        """Of the values."""
        if self.table is not None:
            return np.dtype(np.uint16)
        low, high = self.description.reach()
        if self.description.matrix == MATRIX_YCGCO:
            high >>= 1
        return np.dtype(np.int64 if low < 0 or high > 65535 else np.uint8 if high <= 255 else np.uint16)

    def corrections(self, components: np.ndarray, reconstructed: np.ndarray) -> dict[str, list[int]] | None:
        """The ids that a decoder would get wrong; None if there are none."""
        if self.table is None:
            return None
        true, found = self.table.ranks(components[:, 0]), self.table.ranks(reconstructed[:, 0])
        wrong = np.flatnonzero(true != found)
        if len(wrong) == 0:
            return None
        return {"steps": np.diff(wrong, prepend=0).tolist(), "differences": (true - found)[wrong].tolist()}

    def _ids(self, components: np.ndarray, corrections: Mapping[str, Any] | None) -> np.ndarray:
        assert self.table is not None
        ranks = self.table.ranks(components)
        if corrections is not None:
            try:
                where = np.cumsum(np.asarray(corrections["steps"], np.int64))
                right = ranks[where] + np.asarray(corrections["differences"], np.int64)
                if len(where) and (where.min() < 0 or right.min() < 0 or right.max() >= len(self.table.ids)):
                    raise IndexError
                ranks[where] = right
            except (KeyError, ValueError, TypeError, IndexError, OverflowError):
                raise FormatError(f"corrections of attribute {self.name} do not fit it") from None
        return self.table.ids[ranks]


def _rgb_of_ycgco(components: np.ndarray, bits: int) -> np.ndarray:
    """R, G, B of Y, Cg, Co [N, 3] by the reversible transform, of colours of so many bits."""
    middle = 1 << bits
    green_difference, orange = components[:, 1] - middle, components[:, 2] - middle
    t = components[:, 0] - (green_difference >> 1)
    green, blue = green_difference + t, t - (orange >> 1)
    rgb = np.stack([orange + blue, green, blue], 1).clip(0, middle - 1)
    return rgb.astype(np.uint8 if bits <= 8 else np.uint16)


def _most_frequent(values: np.ndarray, starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Place of the most frequent value in each run; of equals the smallest value."""
    run = np.repeat(np.arange(len(counts)), counts)
    pairs, first, frequency = np.unique(
        run.astype(np.int64) << 16 | values.astype(np.int64), return_index=True, return_counts=True
    )
    best = np.lexsort((pairs & 0xFFFF, -frequency, pairs >> 16))
    of_run = np.searchsorted((pairs >> 16)[best], np.arange(len(counts)))
    return first[best][of_run]


@dataclass(frozen=True)
class AttributeSummary:
    """What the coding of an attribute depends on: type and number of components, lowest and highest value, and of a
    lossless one its ids, rising."""

    dtype: np.dtype
    components: int
    low: int
    high: int
    ids: np.ndarray

    @staticmethod
    def of(values: np.ndarray, own: AttributeSettings) -> AttributeSummary:
        """That of whole numbers [N], [N, 1] or [N, 3], N > 0."""
        components = 3 if values.ndim == 2 and values.shape[1] == 3 else 1
        ids = np.unique(values) if own.lossless else np.empty(0, values.dtype)
        return AttributeSummary(values.dtype, components, int(values.min()), int(values.max()), ids)

    def join(self, other: AttributeSummary) -> AttributeSummary:
        """That of the values of both."""
        ids = np.union1d(self.ids, other.ids)
        return replace(self, low=min(self.low, other.low), high=max(self.high, other.high), ids=ids)


def plan_attributes(
    attributes: Mapping[str, np.ndarray], count: int, settings: CodecSettings
) -> list[tuple[CodedAttribute, AttributeParameters]]:
    """How each of the attributes is coded.

    Raises:
        ConfigError: an array of wrong shape, type or range, or settings that do not fit it.
    """
    for name, values in attributes.items():
        _check_array(name, np.asarray(values), count)
    return plan_summaries(
        {name: AttributeSummary.of(np.asarray(v), settings.attribute(name)) for name, v in attributes.items()}, settings
    )


def plan_summaries(
    attributes: Mapping[str, AttributeSummary], settings: CodecSettings
) -> list[tuple[CodedAttribute, AttributeParameters]]:
    """`plan_attributes` of arrays of which only so much is known; errors as there."""
    unknown = set(settings.attributes) - set(attributes)
    if unknown:
        raise ConfigError(f"CodecSettings.attributes: there is no attribute {sorted(unknown)[0]!r}")
    plans: list[tuple[CodedAttribute, AttributeParameters]] = []
    sets: dict[AttributeParameters, int] = {}
    described = {name: _describe(name, summary, settings.attribute(name)) for name, summary in attributes.items()}
    tables = _tables(attributes, described, settings)
    for index, name in enumerate(attributes):
        own, description, table = settings.attribute(name), described[name], tables.get(name)
        if table is not None and _scale_tells_stride(described, tables):
            description = replace(description, fraction_bits=table.bits)
        instance = sum(plan.description.label == description.label for plan, _ in plans)
        plan = CodedAttribute(name, index, replace(description, instance=instance), table)
        parameters = _parameters(name, description.bit_depth, own, settings, table)
        # Attributes that are coded alike share a set: its id has 4 bits, and whole Gaussians have up to 21 attributes.
        plans.append((plan, replace(parameters, attribute_id=sets.setdefault(parameters, len(sets)))))
    if len(sets) > MAX_PARAMETER_SETS:
        raise ConfigError(
            f"{len(plans)} attributes with {len(sets)} different quantisers; a stream has room for {MAX_PARAMETER_SETS}"
        )
    if len(plans) > SequenceLimits.max_attributes:
        raise ConfigError(f"{len(plans)} attributes; {SequenceLimits.max_attributes} are supported")
    return plans


def _tables(
    attributes: Mapping[str, AttributeSummary], described: Mapping[str, AttributeDescription], settings: CodecSettings
) -> dict[str, IdTable]:
    """Of the lossless attributes. All have one stride: the reference decoder takes the first's for all."""
    ids = {name: summary.ids for name, summary in attributes.items() if settings.attribute(name).lossless}
    bits = min((IdTable.of(values).bits for values in ids.values()), default=0)
    return {name: IdTable.of(values, bits) for name, values in ids.items()}


def _scale_tells_stride(described: Mapping[str, AttributeDescription], tables: Mapping[str, IdTable]) -> bool:
    """Whether the stride of ids stands in the sequence parameter set: not beside a reflectance, to which the reference
    decoder would apply it."""
    return all(name in tables for name, description in described.items() if description.label == "reflectance")


def _check_array(name: str, values: np.ndarray, count: int) -> None:
    if values.shape not in ((count,), (count, 1), (count, 3)):
        raise ConfigError(f"attribute {name!r}: expected [{count}] or [{count}, 3] values, found {list(values.shape)}")
    if not np.issubdtype(values.dtype, np.integer):
        raise ConfigError(f"attribute {name!r}: expected whole numbers, found {values.dtype}")


def _describe(name: str, values: AttributeSummary, own: AttributeSettings) -> AttributeDescription:
    components = values.components
    low, high = (round((value - own.offset) / own.scale) for value in (values.low, values.high))
    depth = own.bit_depth or (8 if values.dtype == np.uint8 else 16)
    space = own.color_space or ("ycbcr" if components == 3 and values.dtype == np.uint8 and depth == 8 else "none")
    if own.lossless:
        depth, space = 16, "none"
    if own.lossless and components != 1:
        raise ConfigError(f"attribute {name!r}: only attributes of one component can be lossless")
    if space != "none" and components != 3:
        raise ConfigError(f"attribute {name!r}: colour space {space} needs 3 components")
    if space == "ycbcr" and depth != 8:
        raise ConfigError(f"attribute {name!r}: colour space ycbcr needs 8 bits, found {depth}")
    if low < 0 or high >= 1 << depth:
        raise ConfigError(f"attribute {name!r}: values {values.low} to {values.high} do not fit in {depth} bits")
    label = own.label or ("color" if components == 3 else "reflectance")
    if label not in KNOWN_LABELS:
        raise ConfigError(f"attribute {name!r}: label {label!r} is not one of {', '.join(KNOWN_LABELS)}")
    matrix = {"ycbcr": MATRIX_BT709, "identity": MATRIX_IDENTITY}.get(space)
    if matrix is not None and (own.scale, own.offset) != (1, 0):
        raise ConfigError(f"attribute {name!r}: colour space {space} goes without scale and offset")
    return AttributeDescription(label, components, depth, 0, matrix, True, own.offset, own.scale)


def _parameters(
    name: str, depth: int, own: AttributeSettings, settings: CodecSettings, table: IdTable | None
) -> AttributeParameters:
    qp = settings.qp if own.qp is None else own.qp
    offset = settings.chroma_offset if own.chroma_offset is None else own.chroma_offset
    if table is not None:
        qp, offset = table.qp(), 0
    elif qp > highest_qp(depth):
        raise ConfigError(f"attribute {name!r}: qp: expected 4 to {highest_qp(depth)} for {depth} bits, found {qp}")
    return AttributeParameters(qp, offset, settings.raht_prediction)
