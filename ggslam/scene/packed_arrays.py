# SPDX-License-Identifier: Apache-2.0
"""Packs named arrays and files without loss: LZMA (the .xz format) after transforms that make arrays more regular.

An array is compressed as it lies, as planes (the first bytes of all numbers, then the second ones), or as planes of the
differences from row to row, whichever is smallest.
"""

from __future__ import annotations

import json
import lzma
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ggslam.errors import FormatError
from ggslam.scene.arrays import ArrayLimits
from ggslam.system.tuning import Tuning

_MAGIC = b"ggslam-arrays-1\n"


class PackedArrayLimits(Tuning):
    """Limits of packed arrays in untrusted files."""

    max_memory = 128 << 20
    """Most bytes of memory that the decompressor may use."""


_PRESET = 9 | lzma.PRESET_EXTREME
_FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": _PRESET, "lc": 0, "lp": 0, "pb": 0}]


def pack_bytes(data: bytes) -> bytes:
    """The .xz file of `data`."""
    return lzma.compress(data, preset=_PRESET)


def unpack_bytes(data: bytes, most: int = ArrayLimits.max_bytes) -> bytes:
    """What a .xz file holds.

    Raises:
        FormatError: damaged, or more than `most` bytes.
    """
    try:
        inflater = lzma.LZMADecompressor(lzma.FORMAT_XZ, PackedArrayLimits.max_memory)
        content = inflater.decompress(data, most + 1)
    except lzma.LZMAError as error:
        raise FormatError(f"damaged: {error}") from None
    if len(content) > most or not inflater.eof or inflater.unused_data:
        raise FormatError("damaged: it is too short or too long")
    return content


def pack_arrays(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Content of a file that `unpack_arrays` reads; of numbers, not of objects."""
    head, bodies = [], []
    for name, values in arrays.items():
        stored = np.ascontiguousarray(values.astype(values.dtype.newbyteorder("<")))
        ways = {"plain": stored.tobytes(), "planes": _planes(stored)}
        if stored.dtype.kind in "iu" and stored.ndim:
            ways["steps"] = _planes(_steps(stored))
        small = {way: lzma.compress(data, filters=_FILTERS) for way, data in ways.items()}
        way = min(small, key=lambda key: len(small[key]))
        head.append([name, stored.dtype.str, list(values.shape), way, len(small[way])])
        bodies.append(small[way])
    text = json.dumps(head, separators=(",", ":")).encode()
    return _MAGIC + len(text).to_bytes(4, "little") + text + b"".join(bodies)


def unpack_arrays(data: bytes) -> dict[str, np.ndarray]:
    """The arrays that `pack_arrays` was given.

    Raises:
        FormatError: damaged, or an array of more than `ArrayLimits.max_bytes`, or all together of more than four times
            that and more than `ArrayLimits.max_ratio` times the packed bytes.
    """
    begin = len(_MAGIC) + 4
    if data[: len(_MAGIC)] != _MAGIC or len(data) < begin:
        raise FormatError("these are not packed arrays of ggslam")
    at = begin + int.from_bytes(data[begin - 4 : begin], "little")
    arrays: dict[str, np.ndarray] = {}
    left = max(4 * ArrayLimits.max_bytes, ArrayLimits.max_ratio * len(data))
    try:
        for name, kind, shape, way, size in json.loads(data[begin:at]):
            arrays[str(name)] = _array(data[at : at + size], np.dtype(kind), shape, way, left)
            left -= arrays[str(name)].nbytes
            at += size
    except (ValueError, TypeError, RecursionError, OverflowError) as error:
        raise FormatError(f"damaged: {error}") from None
    if at != len(data):
        raise FormatError("damaged: it is too short or too long")
    return arrays


def _array(data: bytes, kind: np.dtype, shape: Any, way: str, left: int) -> np.ndarray:
    if kind.kind not in "biuf" or any(not isinstance(n, int) or n < 0 for n in shape):
        raise FormatError(f"damaged: an array has the type {kind}")
    size = math.prod(shape) * kind.itemsize
    if size > min(ArrayLimits.max_bytes, left):
        raise FormatError(f"damaged: an array claims {size} bytes")
    content = unpack_bytes(data, size)
    if size == 0:
        return np.zeros(shape, kind.newbyteorder("="))
    if len(content) != size:
        raise FormatError("damaged: an array has another size than it claims")
    if way == "plain":
        return np.frombuffer(content, kind).reshape(shape).astype(kind.newbyteorder("="))
    rows = np.frombuffer(content, np.uint8).reshape(kind.itemsize, -1).T
    values = np.ascontiguousarray(rows).view(kind).reshape(shape)
    if way == "steps":
        width = kind.itemsize
        zigzag = values.view(f"<u{width}")
        steps = (zigzag >> 1) ^ (0 - (zigzag & 1))
        values = np.cumsum(steps, axis=0, dtype=f"<u{width}").view(kind)
    elif way != "planes":
        raise FormatError(f"damaged: {way!r}")
    return values.astype(kind.newbyteorder("="))


def _planes(values: np.ndarray) -> bytes:
    return np.ascontiguousarray(values.reshape(-1).view(np.uint8).reshape(-1, values.dtype.itemsize).T).tobytes()


def _steps(values: np.ndarray) -> np.ndarray:
    """Differences from row to row, modulo their range, small ones of either sign as small numbers."""
    unsigned = values.view(f"<u{values.dtype.itemsize}")
    steps = unsigned.copy()
    steps[1:] -= unsigned[:-1]
    signed = steps.view(f"<i{values.dtype.itemsize}")
    return ((signed << 1) ^ (signed >> (8 * values.dtype.itemsize - 1))).view(steps.dtype)
