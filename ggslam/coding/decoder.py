# SPDX-License-Identifier: Apache-2.0
"""`decode_cloud` and partial decoding: G-PCC streams (ISO/IEC 23090-9, first edition) become point clouds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ggslam.coding.cloud import PointCloud
from ggslam.coding.parallel_slices import in_order
from ggslam.coding.slice_coder import SliceCoder
from ggslam.coding.stream import CodedSliceUnits, CodedStream, read_stream
from ggslam.errors import FormatError


@dataclass(frozen=True)
class SliceInfo:
    """What a stream says of a slice before it is decoded: `low` and `high` bound its points, in metres."""

    slice_id: int
    points: int
    size_bytes: int
    low: np.ndarray
    high: np.ndarray


def decode_cloud(data: bytes | memoryview, threads: int | None = None) -> PointCloud:
    """Decodes a stream. Slices come in the order of the stream, points of a slice in Morton order.

    Args:
        threads: that decode slices; None: one for each processor.

    Raises:
        FormatError: the stream is damaged, or uses a tool that this decoder lacks (the message names it).
    """
    stream = _whole(data)
    return _decode(stream, range(len(stream.slices)), threads)


def _whole(data: bytes | memoryview) -> CodedStream:
    """The stream; FormatError, if slices are missing."""
    stream = read_stream(data)
    written = stream.side.get("slices", len(stream.slices))
    if written != len(stream.slices):
        raise FormatError(
            f"the stream has {len(stream.slices)} of its {written} slices: was it cut off? "
            "(ggslam.coding.decode_slice reads those that are there)"
        )
    return stream


@dataclass(frozen=True)
class CloudInParts:
    """A stream that is decoded slice by slice.

    Attributes:
        count: points of all slices.
        like: a cloud without points, with the attributes and all that is known of them together.
        parts: the slices as clouds, in the order of the stream; raises FormatError if one is damaged.
    """

    count: int
    like: PointCloud
    parts: Iterator[PointCloud]


def decode_in_parts(data: bytes | memoryview, threads: int | None = None) -> CloudInParts:
    """`decode_cloud` slice by slice: no more slices are decoded in memory than two for each thread."""
    stream = _whole(data)

    chains = _chains(stream, range(len(stream.slices)))

    def decode_part(number: int) -> PointCloud:
        return _join(stream, list(_decode_chain(stream, chains[number]).values()))

    count = sum(units.header.points for units in stream.slices)
    return CloudInParts(count, _join(stream, []), in_order(decode_part, len(chains), threads))


def list_slices(data: bytes | memoryview) -> list[SliceInfo]:
    """The slices of a stream; nothing is decoded but headers."""
    stream = read_stream(data)
    boxes = [_corners(stream, units) for units in stream.slices]
    return [
        SliceInfo(units.header.slice_id, units.header.points, units.size, box[0], box[1])
        for units, box in zip(stream.slices, boxes, strict=True)
    ]


def _corners(stream: CodedStream, units: CodedSliceUnits) -> np.ndarray:
    """Lowest and highest position, float64 [2, 3], that a slice can hold."""
    low = np.asarray(units.header.grid_origin, np.int64)
    size = np.array([1 << units.header.size_log2[axis] for axis in stream.sequence.axes])
    return stream.quantization.restore(np.stack([low, low + size - 1]))


def decode_slice(data: bytes | memoryview, slice_id: int) -> PointCloud:
    """Decodes the slice of this id (all of them, if several share it) and no other.

    Raises:
        FormatError: the stream is damaged or has no such slice.
    """
    stream = read_stream(data)
    chosen = [number for number, units in enumerate(stream.slices) if units.header.slice_id == slice_id]
    if not chosen:
        ids = sorted({units.header.slice_id for units in stream.slices})
        raise FormatError(f"the stream has no slice {slice_id}; it has {ids[0]} to {ids[-1]}")
    return _decode(stream, chosen, 1)


def decode_box(data: bytes | memoryview, low: Sequence[float], high: Sequence[float]) -> PointCloud:
    """The points within a box, metres, both ends included (and a millionth of a voxel more, for corners that lie on
    the grid); slices that lie outside are not decoded."""
    stream = read_stream(data)
    reach = 1e-6 * stream.quantization.voxel_size
    first, last = np.asarray(low, np.float64) - reach, np.asarray(high, np.float64) + reach
    chosen = []
    for number, units in enumerate(stream.slices):
        corners = _corners(stream, units)
        if (corners[0] <= last).all() and (corners[1] >= first).all():
            chosen.append(number)
    cloud = _decode(stream, chosen, None)
    points = cloud.points
    inside = ((points >= first) & (points <= last)).all(1)
    attributes = {name: values[inside] for name, values in cloud.attributes.items()}
    return replace(cloud, grid_points=cloud.grid_points[inside], attributes=attributes)


SlicePart = tuple[np.ndarray, dict[str, np.ndarray]]
"""Grid positions and attributes."""


def _decode(stream: CodedStream, wanted: Sequence[int], threads: int | None) -> PointCloud:
    """The slices of these numbers, rising."""
    chains = _chains(stream, wanted)
    parts: dict[int, SlicePart] = {}
    for chain in in_order(lambda number: _decode_chain(stream, chains[number]), len(chains), threads):
        parts |= chain
    return _join(stream, [parts[number] for number in wanted])


def _join(stream: CodedStream, parts: Sequence[SlicePart]) -> PointCloud:
    grid = _concatenate([part[0] for part in parts], (0, 3), np.int32)
    attributes = {}
    for attribute in stream.attributes:
        shape = (0,) if attribute.description.components == 1 else (0, 3)
        attributes[attribute.name] = _concatenate([part[1][attribute.name] for part in parts], shape, attribute.dtype)
    metadata = stream.side.get("metadata")
    ids = frozenset(attribute.name for attribute in stream.attributes if attribute.table is not None)
    return PointCloud(grid, attributes, stream.quantization, metadata if isinstance(metadata, dict) else {}, ids)


def _concatenate(parts: list[np.ndarray], empty: tuple[int, ...], dtype: type | np.dtype) -> np.ndarray:
    if len(parts) == 1:
        return parts[0]
    return np.concatenate(parts) if parts else np.empty(empty, dtype)


def _decode_slice(
    stream: CodedStream, units: CodedSliceUnits, before: SliceCoder | None = None
) -> tuple[np.ndarray, dict[str, np.ndarray], SliceCoder]:
    """Positions and attributes of a slice, and its coder, with whose contexts the next slice may go on."""
    header = units.header
    try:
        coder = SliceCoder()
        if before is not None:
            coder.go_on(before)
        grid = coder.decode_geometry(units.geometry, header, units.payload, stream.context)
        grid = grid[:, stream.sequence.axes] + np.asarray(header.grid_origin, np.int32)
        attributes = {}
        for attribute in stream.attributes:
            components = coder.decode_unit(units.attributes[attribute.index], attribute.description, stream.context)
            attributes[attribute.name] = attribute.values(components, units.corrections.get(attribute.name))
    except FormatError as error:
        raise FormatError(f"slice {header.slice_id}: {error}") from None
    return grid, attributes, coder


def _decode_chain(stream: CodedStream, numbers: Sequence[int]) -> dict[int, SlicePart]:
    """Slices that go on with one another's contexts, by number."""
    parts, coder = {}, None
    for number in numbers:
        grid, attributes, coder = _decode_slice(stream, stream.slices[number], coder)
        parts[number] = (grid, attributes)
    return parts


def _chains(stream: CodedStream, wanted: Sequence[int]) -> list[list[int]]:
    """Numbers of slices that must be decoded for the wanted ones, in runs that go on with one another."""
    chains: list[list[int]] = []
    for number, units in enumerate(stream.slices):
        if units.header.previous is None:
            chains.append([])
        elif not chains or units.header.previous != stream.slices[number - 1].header.slice_id:
            raise FormatError(f"slice {units.header.slice_id} goes on with another than the one before it")
        chains[-1].append(number)
    wanted_set = set(wanted)
    cut = [[n for n in chain if n <= max(wanted_set.intersection(chain), default=-1)] for chain in chains]
    return [chain for chain in cut if chain]
