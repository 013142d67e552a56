# SPDX-License-Identifier: Apache-2.0
"""Bit fields of the high-level syntax (ISO/IEC 23090-9, first edition): u(n), ue(v), se(v), s(n).

The exponential Golomb code of the first edition has a prefix of ones, not of zeros as in the video standards.
"""

from __future__ import annotations

from typing import Final

from ggslam.errors import FormatError

MAX_GOLOMB_PREFIX: Final = 32
"""Longest prefix of an exponential Golomb code: values have at most 32 bits."""


class BitWriter:
    """Fields are appended, most significant bit first."""

    def __init__(self) -> None:
        self._value = 0
        self._bits = 0

    def u(self, bits: int, value: int) -> None:
        """Unsigned integer of `bits` bits."""
        if not 0 <= value < 1 << bits:
            raise ValueError(f"{value} does not fit in {bits} bits")
        self._value = self._value << bits | int(value)
        self._bits += bits

    def flag(self, value: bool) -> None:
        self.u(1, int(value))

    def ue(self, value: int) -> None:
        """Unsigned exponential Golomb: with l = floor(log2(value + 1)), l ones, a zero, the l low bits of value + 1."""
        length = (value + 1).bit_length() - 1
        if value < 0 or length >= MAX_GOLOMB_PREFIX:
            raise ValueError(f"{value} has no exponential Golomb code")
        self.u(length + 1, (1 << (length + 1)) - 2)
        self.u(length, value + 1 - (1 << length))

    def se(self, value: int) -> None:
        """Signed exponential Golomb: 2 |value| - (value > 0) as ue."""
        self.ue(2 * abs(value) - (value > 0))

    def s(self, bits: int, value: int) -> None:
        """Magnitude of `bits` bits, then the sign bit."""
        self.u(bits, abs(value))
        self.flag(value < 0)

    def align(self) -> None:
        """Zero bits up to the next byte."""
        self.u(-self._bits % 8, 0)

    def data(self) -> bytes:
        """Everything written, aligned."""
        self.align()
        return self._value.to_bytes(self._bits // 8, "big")


class BitReader:
    """Fields are taken off `data`.

    Args:
        data: the bytes.
        what: name of the unit, for messages.

    Raises:
        FormatError: by every method, when the data ends early or a field has no valid value.
    """

    def __init__(self, data: bytes | memoryview, what: str) -> None:
        self._data = bytes(data)
        self._at = 0
        self.what = what

    def u(self, bits: int) -> int:
        end = self._at + bits
        if end > 8 * len(self._data):
            raise FormatError(f"{self.what} ends early, after {len(self._data)} bytes")
        first, last = self._at // 8, (end + 7) // 8
        value = int.from_bytes(self._data[first:last], "big") >> (8 * last - end)
        self._at = end
        return value & ((1 << bits) - 1)

    def flag(self) -> bool:
        return bool(self.u(1))

    def ue(self) -> int:
        length = 0
        while self.u(1):
            length += 1
            if length >= MAX_GOLOMB_PREFIX:
                raise FormatError(f"{self.what} holds an impossible number")
        return (1 << length | self.u(length)) - 1

    def se(self) -> int:
        code = self.ue()
        return (code + 1) // 2 if code & 1 else -(code // 2)

    def s(self, bits: int) -> int:
        magnitude = self.u(bits)
        return -magnitude if self.flag() else magnitude

    def align(self) -> None:
        """Skips to the next byte; the bits between must be zero."""
        if self.u(-self._at % 8) != 0:
            raise FormatError(f"{self.what}: alignment bits are not zero")

    def finish(self) -> None:
        """The unit must end here, but for alignment."""
        self.align()
        if self._at != 8 * len(self._data):
            raise FormatError(f"{self.what} is longer than its syntax: {len(self._data)} bytes, {self._at // 8} read")

    @property
    def byte_position(self) -> int:
        """Number of whole bytes read; call after `align`."""
        return self._at // 8
