# SPDX-License-Identifier: Apache-2.0
"""Writes CDR by hand where a message has thousands of small parts, which a serialiser of Python objects is slow at."""

from __future__ import annotations

import struct
from typing import Final

import numpy as np

HEADER: Final = b"\x00\x01\x00\x00"
"""Little-endian CDR."""


class CdrWriter:
    """Appends numbers, texts and arrays, each aligned to its size, as CDR wants."""

    def __init__(self) -> None:
        self._data = bytearray(HEADER)

    def align(self, size: int) -> None:
        """Fills up to a multiple of `size` bytes."""
        self._data += bytes(-(len(self._data) - len(HEADER)) % size)

    def numbers(self, code: str, *values: float) -> None:
        """Numbers of one type, by struct's letter."""
        self.align(struct.calcsize(code))
        self._data += struct.pack(f"<{len(values)}{code}", *values)

    def text(self, text: str) -> None:
        """A string."""
        content = text.encode()
        self.numbers("I", len(content) + 1)
        self._data += content + b"\0"

    def rows(self, values: np.ndarray, size: int) -> None:
        """The bytes of an array whose elements align to `size`."""
        if values.size:
            self.align(size)
            self._data += np.ascontiguousarray(values).view(np.uint8).reshape(-1).data

    def sequence(self, values: np.ndarray, size: int) -> None:
        """A sequence whose elements are the rows of an array."""
        self.numbers("I", len(values))
        self.rows(values, size)

    def content(self) -> bytes:
        """All that was written, with CDR's header."""
        return bytes(self._data)
