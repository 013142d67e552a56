# SPDX-License-Identifier: Apache-2.0
"""What the standard has no field for, in user data units: names of attributes, the exact scale, tables of ids.

A unit is a signature with the version of the stream, then deflated JSON. Decoders that do not know the signature skip
the unit. Streams of version 1 have square roots of their own for weights above 65,536 (see fixed_point.hpp).
"""

from __future__ import annotations

import json
import zlib
from typing import Any, Final

from ggslam.errors import FormatError
from ggslam.system.tuning import Tuning

VERSION: Final = 2
"""Version of our user data in a stream."""
_SIGNATURES = {b"ggslam-1": 1, b"ggslam-2": VERSION}
_SIGNATURE_BYTES: Final = 8
"""Bytes of the signature before it."""
_SIGNATURE = b"ggslam-2"


class UserDataTuning(Tuning):
    """A limit on hostile streams."""

    max_bytes = 1 << 21
    """Bytes of JSON in a unit: the names of 65,535 objects fit; in memory they take about 30 times as many."""


def write_user_data(content: dict[str, Any]) -> bytes:
    """Payload of a unit with this content."""
    return _SIGNATURE + zlib.compress(json.dumps(content, separators=(",", ":")).encode(), 9)


def version_of(payload: bytes | memoryview) -> int | None:
    """Version of the stream that a unit belongs to; None if the unit is somebody else's."""
    return _SIGNATURES.get(bytes(payload[:_SIGNATURE_BYTES]))


def read_user_data(payload: bytes | memoryview) -> dict[str, Any]:
    """Content of a unit; empty if it is somebody else's.

    Raises:
        FormatError: ours, but damaged.
    """
    data = bytes(payload)
    if version_of(data) is None:
        return {}
    inflater = zlib.decompressobj()
    try:
        content = json.loads(inflater.decompress(data[_SIGNATURE_BYTES:], UserDataTuning.max_bytes))
    except (zlib.error, ValueError, RecursionError) as error:
        raise FormatError(f"a user data unit is damaged: {error}") from None
    if not isinstance(content, dict) or not inflater.eof:
        raise FormatError("a user data unit is damaged")
    return content
