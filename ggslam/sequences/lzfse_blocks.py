# SPDX-License-Identifier: Apache-2.0
"""Computes the size that an LZFSE stream expands to from its block headers (lzfse_internal.h of Apple's reference),
because the decompressor has no limit."""

from __future__ import annotations

import struct

END = b"bvx$"


def claimed_bytes(content: bytes) -> int:
    """Bytes that a whole stream expands to.

    Raises:
        ValueError: it has no end, or a block that is none.
    """
    at, total = 0, 0
    while (kind := content[at : at + 4]) != END:
        try:
            size, length = _block(kind, content, at)
        except struct.error:
            raise ValueError("truncated") from None
        at, total = at + length, total + size
    return total


def _block(kind: bytes, content: bytes, at: int) -> tuple[int, int]:
    """Bytes that a block expands to, and its own."""
    (size,) = struct.unpack_from("<I", content, at + 4)
    if kind == b"bvx-":  # stored
        return size, 8 + size
    if kind == b"bvxn":  # LZVN
        return size, 12 + struct.unpack_from("<I", content, at + 8)[0]
    if kind == b"bvx2":
        literals, matches, states = struct.unpack_from("<3Q", content, at + 8)
        head = states & 0xFFFFFFFF
        if head < 32:
            raise ValueError("a block with a header of no length")
        return size, head + (literals >> 20 & 0xFFFFF) + (matches >> 40 & 0xFFFFF)
    raise ValueError(f"a block {kind!r}")
