# SPDX-License-Identifier: Apache-2.0
"""One slice's octree in the compiled core, with what is coded over it. The core's functions release the interpreter's
lock, so that slices are coded side by side."""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Final

import numpy as np

from ggslam.abi.core import RahtSettings, Status
from ggslam.coding.attribute_syntax import RAHT, RAW
from ggslam.coding.geometry_syntax import GeometryHeader, GeometryParameters
from ggslam.coding.native_settings import (
    AttributePayload,
    CodingContext,
    detail_settings,
    layer_qps,
    octree_settings,
    predictive_settings,
    raht_settings,
    tree_settings,
)
from ggslam.coding.sequence_parameters import AttributeDescription
from ggslam.errors import FormatError
from ggslam.native.loader import NativeContext, load_library

_REASONS = {
    Status.TRUNCATED: "the payload ends early or is damaged",
    Status.COUNT_MISMATCH: "the payload has another number of points than its unit states",
    Status.TOO_LARGE: "the octree has more nodes than the decoder is willing to hold",
}
MAX_SLICE_POINTS: Final = 1 << 24
"""Points of a slice: their number has 24 bits."""


@lru_cache(maxsize=1)
def _context() -> NativeContext:
    """Names the instruction set; its pool is not used, so all threads may share it."""
    return NativeContext(threads=1)


def _check(status: int) -> int:
    """Sizes pass; negative values are errors."""
    if status >= 0:
        return status
    if -status == Status.OUT_OF_MEMORY:
        raise MemoryError("the codec ran out of memory")
    raise FormatError(_REASONS[Status(-status)])


def _bytes_view(data: bytes | memoryview) -> np.ndarray:
    return np.frombuffer(data, np.uint8) if len(data) else np.empty(0, np.uint8)


class SliceCoder:
    """The octree of one slice in the compiled core, made from points or from a geometry payload.

    Attributes are int32 [points, components] in coding order: Morton order of the positions, x most significant; points
    at one place keep the order they were given in.
    """

    def __init__(self) -> None:
        self._core = load_library()
        self._context = _context()
        self._handle = self._core.ggslam_gpcc_slice_create()
        if not self._handle:
            raise MemoryError("the codec ran out of memory")
        self.points = 0
        self.depth = 0

    def __del__(self) -> None:
        if getattr(self, "_handle", None):
            self._core.ggslam_gpcc_slice_destroy(self._handle)

    @property
    def leaves(self) -> int:
        """Number of occupied places."""
        return self._core.ggslam_gpcc_leaves(self._handle)

    def build(self, points: np.ndarray, depth: int) -> np.ndarray:
        """Makes the octree of points int32 [N, 3] in [0, 2^depth); returns their coding order uint32 [N]."""
        points = np.ascontiguousarray(points, np.int32)
        order = np.empty(len(points), np.uint32)
        _check(
            self._core.ggslam_gpcc_build(
                self._context.handle, self._handle, points.ctypes.data, len(points), depth, order.ctypes.data
            )
        )
        self.points, self.depth = len(points), depth
        return order

    def nodes(self, level: int) -> int:
        """Number of octree nodes at a level; the root is level 0."""
        return self._core.ggslam_gpcc_nodes(self._handle, level)

    def leaf_points(self) -> np.ndarray:
        """Number of points at each occupied place, uint32 [leaves]."""
        counts = np.empty(self.leaves, np.uint32)
        self._core.ggslam_gpcc_leaf_points(self._handle, counts.ctypes.data)
        return counts

    def merge(self) -> None:
        """Leaves one point at each place."""
        _check(self._core.ggslam_gpcc_merge(self._handle))
        self.points = self.leaves

    def encode_geometry(self, parameters: GeometryParameters, axes: tuple[int, ...] = ()) -> bytes:
        """The arithmetic payload; `axes` as in the header, if the parameters have planes or partial splits."""
        if not parameters.plain_octree:
            tree = tree_settings(parameters, GeometryHeader(0, (0, 0, 0), axes, self.points), False)
            return self._take(_check(self._core.ggslam_gpcc_encode_tree(self._context.handle, self._handle, tree)))
        settings = octree_settings(parameters, self.depth)
        return self._take(
            _check(self._core.ggslam_gpcc_encode_geometry(self._context.handle, self._handle, ctypes.byref(settings)))
        )

    def encode_attribute(self, settings: RahtSettings, values: np.ndarray) -> bytes:
        """The arithmetic payload; `values`, int32 [points, components], become what a decoder reconstructs."""
        _check_values(values, self.points, settings.components)
        size = self._core.ggslam_gpcc_encode_attribute(
            self._context.handle, self._handle, ctypes.byref(settings), values.ctypes.data
        )
        return self._take(_check(size))

    def decode_geometry(
        self, parameters: GeometryParameters, header: GeometryHeader, payload: bytes | memoryview,
        context: CodingContext | None = None,
    ) -> np.ndarray:  # fmt: skip
        """Makes the octree of a payload; returns the positions of its points, int32 [points, 3].

        Raises:
            FormatError: the payload is damaged.
        """
        context = context or CodingContext()
        data, points, separate_bits = _bytes_view(payload), header.points, context.separate_bits
        arguments = (data.ctypes.data, len(data), points)
        handles = (self._context.handle, self._handle)
        if parameters.predictive:
            predictive = predictive_settings(parameters, header, separate_bits)
            _check(self._core.ggslam_gpcc_decode_predictive(*handles, predictive, header.depth, *arguments))
        elif parameters.plain_octree and header.codewords == 1 and not (separate_bits or context.keeps_contexts):
            octree = octree_settings(parameters, header.depth)
            _check(self._core.ggslam_gpcc_decode_geometry(*handles, octree, *arguments))
        else:
            tree = tree_settings(parameters, header, separate_bits)
            _check(self._core.ggslam_gpcc_decode_tree(*handles, tree, header.depth, *arguments))
        self.points, self.depth = points, header.depth
        return self.positions()

    def go_on(self, before: SliceCoder) -> None:
        """Takes over the contexts that another slice ended with."""
        _check(self._core.ggslam_gpcc_go_on(self._handle, before._handle))

    def positions(self) -> np.ndarray:
        """Positions int32 [points, 3] in coding order."""
        positions = np.empty((self.points, 3), np.int32)
        _check(self._core.ggslam_gpcc_positions(self._context.handle, self._handle, positions.ctypes.data))
        return positions

    def decode_attribute(self, settings: RahtSettings, payload: bytes | memoryview) -> np.ndarray:
        """Values int32 [points, components].

        Raises:
            FormatError: the payload is damaged.
        """
        values, data = np.empty((self.points, settings.components), np.int32), _bytes_view(payload)
        _check(
            self._core.ggslam_gpcc_decode_attribute(
                self._context.handle, self._handle, ctypes.byref(settings), data.ctypes.data, len(data),
                values.ctypes.data,
            )
        )  # fmt: skip
        return values

    def decode_unit(
        self, coded: AttributePayload, description: AttributeDescription, context: CodingContext
    ) -> np.ndarray:
        """Values int32 [points, components] of an attribute unit, by whichever transform it has.

        Raises:
            FormatError: the payload is damaged.
        """
        encoding = coded.parameters.encoding
        if encoding == RAW:
            return self._raw(coded, description)
        index = coded.header.attribute if context.keeps_contexts else -1
        if encoding == RAHT:
            settings = raht_settings(
                coded.parameters, description.components, description.bit_depth, coded.header.qp_deltas,
                first_version=context.first_version,
            )  # fmt: skip
            settings.layers, settings.layer_qps = layer_qps(coded, description.bit_depth)
            settings.separate_bits, settings.index = int(context.separate_bits), index
            return self.decode_attribute(settings, coded.payload)
        details = detail_settings(coded, description, context, index)
        values, data = np.empty((self.points, description.components), np.int32), _bytes_view(coded.payload)
        _check(
            self._core.ggslam_gpcc_decode_details(
                self._context.handle, self._handle, details, data.ctypes.data, len(data), values.ctypes.data
            )
        )
        return values

    def _raw(self, coded: AttributePayload, description: AttributeDescription) -> np.ndarray:
        """Raw values: fixed numbers of bits, or whole bytes with their number before each."""
        count = self.points * description.components
        if coded.parameters.variable_length:
            values = _variable_values(bytes(coded.payload), count)
        else:
            bits = np.unpackbits(_bytes_view(coded.payload), count=count * description.bit_depth)
            if len(coded.payload) * 8 < count * description.bit_depth:
                raise FormatError(_REASONS[Status.TRUNCATED])
            weights = 1 << np.arange(description.bit_depth - 1, -1, -1)
            values = bits.reshape(count, -1) @ weights
        values = np.ascontiguousarray(values.reshape(self.points, -1), np.int32)
        _check(self._core.ggslam_gpcc_sort_values(self._handle, description.components, values.ctypes.data))
        return values

    def _take(self, size: int) -> bytes:
        out = np.empty(size, np.uint8)
        self._core.ggslam_gpcc_take(self._handle, out.ctypes.data)
        return out.tobytes()


def rgb_to_ycbcr(rgb: np.ndarray, order: np.ndarray) -> np.ndarray:
    """BT.709 full-range Y, Cb, Cr int32 [M, 3] of the colours uint8 [N, 3] picked by `order` uint32 [M]."""
    rgb = np.ascontiguousarray(rgb, np.uint8)
    out = np.empty((len(order), 3), np.int32)
    load_library().ggslam_gpcc_to_ycbcr(
        _context().handle, rgb.ctypes.data, len(rgb), order.ctypes.data, len(order), out.ctypes.data
    )
    return out


def ycbcr_to_rgb(components: np.ndarray) -> np.ndarray:
    """The inverse: uint8 [N, 3] of int32 [N, 3] in [0, 255]."""
    rgb = np.empty(components.shape, np.uint8)
    load_library().ggslam_gpcc_from_ycbcr(_context().handle, components.ctypes.data, len(components), rgb.ctypes.data)
    return rgb


def _variable_values(data: bytes, count: int) -> np.ndarray:
    """Numbers of 0 to 4 bytes, each behind its length."""
    out = np.empty(count, np.int64)
    at = 0
    for i in range(count):
        length = data[at] if at < len(data) else 255
        if length > 2 or at + 1 + length > len(data):
            raise FormatError(_REASONS[Status.TRUNCATED])
        out[i] = int.from_bytes(data[at + 1 : at + 1 + length], "big")
        at += 1 + length
    return out


def _check_values(values: np.ndarray, points: int, components: int) -> None:
    if values.shape != (points, components) or values.dtype != np.int32 or not values.flags.c_contiguous:
        raise ValueError(f"expected contiguous int32 [{points}, {components}], found {values.dtype} {values.shape}")
