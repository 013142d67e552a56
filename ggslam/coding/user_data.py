# SPDX-License-Identifier: Apache-2.0
"""What the standard has no field for, in user data units: names of attributes, the exact scale, tables of ids.

A unit is a signature, then deflated JSON. Decoders that do not know the signature skip the unit.
"""

from __future__ import annotations

import json
import zlib
from typing import Any

from ggslam.errors import FormatError

_SIGNATURE = b"ggslam-1"
_MAX_BYTES = 1 << 24


def write_user_data(content: dict[str, Any]) -> bytes:
    """Payload of a unit with this content."""
    return _SIGNATURE + zlib.compress(json.dumps(content, separators=(",", ":")).encode(), 9)


def read_user_data(payload: bytes | memoryview) -> dict[str, Any]:
    """Content of a unit; empty if it is somebody else's.

    Raises:
        FormatError: ours, but damaged.
    """
    data = bytes(payload)
    if not data.startswith(_SIGNATURE):
        return {}
    inflater = zlib.decompressobj()
    try:
        content = json.loads(inflater.decompress(data[len(_SIGNATURE) :], _MAX_BYTES))
    except (zlib.error, ValueError, RecursionError) as error:
        raise FormatError(f"a user data unit is damaged: {error}") from None
    if not isinstance(content, dict) or not inflater.eof:
        raise FormatError("a user data unit is damaged")
    return content
