# SPDX-License-Identifier: Apache-2.0
"""LZF, the byte-oriented Lempel-Ziv code that compressed PCD files use (format of M. Lehmann's liblzf).

Both directions run in the compiled core (ggslam/native/src/codec/lzf_api.cpp) and release the interpreter's lock.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from ggslam.native.loader import load_library

_MOST_GROWTH: Final = 88
"""Largest growth of LZF: three bytes of a match stand for at most 264."""
_REASONS = {
    -1: "the compressed data end within a match",
    -2: "a match begins before the data",
}


def compress(data: bytes) -> bytes:
    """The LZF code of `data`: at most len(data) / 32 + 1 bytes longer, usually shorter."""
    out = np.empty(len(data) + len(data) // 32 + 1, np.uint8)
    size = load_library().ggslam_lzf_compress(data, len(data), out.ctypes.data, len(out))
    return out[:size].tobytes()


def decompress(data: bytes, size: int) -> bytes:
    """The `size` bytes that `data` stands for.

    Raises:
        ValueError: the data are damaged, or stand for another number of bytes.
    """
    if not 0 <= size <= _MOST_GROWTH * len(data):
        raise ValueError(f"{len(data)} compressed bytes cannot hold {size}")
    out = np.empty(size, np.uint8)
    failure = load_library().ggslam_lzf_decompress(data, len(data), out.ctypes.data, size)
    if failure:
        raise ValueError(_REASONS.get(failure, f"the compressed data are damaged or do not stand for {size} bytes"))
    return out.tobytes()
