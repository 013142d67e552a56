# SPDX-License-Identifier: Apache-2.0
"""LZF, the byte-oriented Lempel-Ziv code that compressed PCD files use (format of M. Lehmann's liblzf)."""

from __future__ import annotations

_MOST_GROWTH = 88
"""Three bytes of a match stand for at most 264."""


def decompress(data: bytes, size: int) -> bytes:
    """The `size` bytes that `data` stands for.

    A byte below 32 says how many literal bytes, less one, follow. Another one begins a match: its upper 3 bits are the
    length less two (7: a byte to add follows), its lower 5 bits and one more byte how far back it lies, less one.

    Raises:
        ValueError: the data are damaged, or stand for another number of bytes.
    """
    if size > _MOST_GROWTH * len(data):
        raise ValueError(f"{len(data)} compressed bytes cannot hold {size}")
    out = bytearray()
    at, end = 0, len(data)
    while at < end and len(out) <= size:
        control = data[at]
        at += 1
        if control < 32:
            out += data[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7 and at < end:
            length += data[at]
            at += 1
        if at >= end:
            raise ValueError("the compressed data end within a match")
        start = len(out) - ((control & 31) << 8) - data[at] - 1
        at += 1
        _copy(out, start, length + 2)
    if at != end or len(out) != size:
        raise ValueError(f"the compressed data stand for {len(out)} bytes or more, expected {size}")
    return bytes(out)


def _copy(out: bytearray, start: int, length: int) -> None:
    """Appends `length` bytes from `start` on; the source may reach into what is being appended."""
    if start < 0:
        raise ValueError("a match begins before the data")
    distance = len(out) - start
    if distance >= length:
        out += out[start : start + length]
    else:
        out += (out[start:] * (length // distance + 1))[:length]
