# SPDX-License-Identifier: Apache-2.0
"""The one decoder of image files: damage is found and memory counted before anything is decoded.

OpenCV returns a half-grey picture for many truncated files and only prints a warning, so the containers are checked
first: every PNG chunk by its length and checksum, a JPEG by its end marker. How many pixels a decoder would make is
read from the header; a picture whose header cannot be read is not decoded.
"""

from __future__ import annotations

import zlib
from pathlib import Path

import cv2
import numpy as np

from ggslam.errors import FormatError, GgslamError
from ggslam.system.opencv import opencv_errors
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import FileTuning, read_untrusted


class PictureLimits(Tuning):
    """A limit on hostile pictures."""

    max_pixels = 100_000_000
    """Largest picture in pixels: more than any camera of a recording has, and 300 MB in memory."""


PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_START = b"\xff\xd8"
_FRAME_MARKERS = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Of JPEG segments that tell the size."""
_BARE_MARKERS = {0x01, *range(0xD0, 0xD8)}
"""JPEG markers without a length."""


def read_picture(
    path: Path, most_pixels: int = PictureLimits.max_pixels, error: type[GgslamError] = FormatError
) -> np.ndarray:
    """A picture in a file of a run, uint8 [H, W, 3] RGB.

    Args:
        path: a PNG or JPEG file.
        most_pixels: that it may have.
        error: class of the error to raise.

    Raises:
        error: missing, no regular file, damaged, no picture, or of more pixels.
    """
    image = decode_image(path, read_image_bytes(path, error), cv2.IMREAD_COLOR, most_pixels, error)
    return np.ascontiguousarray(image[..., ::-1])


def read_image_bytes(path: Path, error: type[GgslamError] = FormatError) -> bytes:
    """The bytes of a PNG or JPEG file, whole.

    Raises:
        error: missing, truncated, damaged, or not an image.
    """
    content = read_untrusted(path, FileTuning.max_image_bytes, error)
    damage = find_damage(content)
    if damage:
        raise error(f"{path}: {damage}")
    return content


def decode_image(
    place: object,
    content: bytes,
    flags: int,
    most_pixels: int = PictureLimits.max_pixels,
    error: type[GgslamError] = FormatError,
) -> np.ndarray:
    """Image of the bytes of a PNG, JPEG or WebP file, as OpenCV decodes it.

    Args:
        place: where it is from, for errors.
        content: the bytes.
        flags: OpenCV's, such as `cv2.IMREAD_UNCHANGED`.
        most_pixels: that its header may claim.
        error: class of the error to raise.

    Raises:
        error: the header claims more, or cannot be read, or OpenCV cannot decode the rest.
        MemoryFullError: memory is full.
    """
    size = claimed_size(content)
    if size is None:
        raise error(f"{place}: cannot be decoded as an image: its header gives no size ({len(content)} bytes)")
    width, height = size
    most = min(most_pixels, PictureLimits.max_pixels)
    if width * height > most:
        raise error(f"{place}: claims {width}x{height} pixels; at most {most:,} are read")
    with opencv_errors(place, error):
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    if image is None:
        raise error(f"{place}: cannot be decoded as an image ({len(content)} bytes)")
    return image


def claimed_size(content: bytes) -> tuple[int, int] | None:
    """(width, height) that the header of a PNG, JPEG or WebP file claims; None where it has none."""
    if content.startswith(PNG_SIGNATURE) and content[12:16] == b"IHDR" and len(content) >= 24:
        return int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big")
    if content.startswith(_JPEG_START):
        return _jpeg_size(content)
    if content[:4] == b"RIFF" and content[8:12] == b"WEBP" and len(content) >= 30:
        return _webp_size(content)
    return None


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    """Only what decoders agree on is followed: None for segments that are not one behind the other."""
    position = 2
    while position + 9 <= len(content) and content[position] == 0xFF:
        marker = content[position + 1]
        if marker in _FRAME_MARKERS:
            height, width = content[position + 5 : position + 7], content[position + 7 : position + 9]
            return int.from_bytes(width, "big"), int.from_bytes(height, "big")
        if marker == 0xFF or marker in _BARE_MARKERS:  # 0xFF: padding
            position += 1 if marker == 0xFF else 2
        else:
            position += 2 + int.from_bytes(content[position + 2 : position + 4], "big")
    return None


def _webp_size(content: bytes) -> tuple[int, int] | None:
    kind = content[12:16]
    if kind == b"VP8 ":
        return int.from_bytes(content[26:28], "little") & 0x3FFF, int.from_bytes(content[28:30], "little") & 0x3FFF
    if kind == b"VP8L":
        bits = int.from_bytes(content[21:25], "little")
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8X":
        return 1 + int.from_bytes(content[24:27], "little"), 1 + int.from_bytes(content[27:30], "little")
    return None


def find_damage(content: bytes) -> str | None:
    """What is wrong with the bytes of a PNG or JPEG file; None when nothing was found."""
    if not content:
        return "file is empty"
    if content.startswith(PNG_SIGNATURE):
        return _find_png_damage(content)
    if content.startswith(_JPEG_START):
        return _find_jpeg_damage(content)
    return f"expected a PNG or JPEG image, found a file that starts with {content[:8]!r}"


def _find_png_damage(content: bytes) -> str | None:
    view, position = memoryview(content), len(PNG_SIGNATURE)
    while position + 12 <= len(content):
        length = int.from_bytes(view[position : position + 4], "big")
        kind = bytes(view[position + 4 : position + 8])
        end = position + 12 + length
        if end > len(content):
            return f"PNG is truncated: its {kind.decode('latin1')} chunk needs {end} bytes, found {len(content)}"
        checksum = int.from_bytes(view[end - 4 : end], "big")
        if zlib.crc32(view[position + 4 : end - 4]) != checksum:
            return f"PNG is damaged: wrong checksum in its {kind.decode('latin1')} chunk"
        if kind == b"IEND":
            return None
        position = end
    return f"PNG is truncated: no end marker in its {len(content)} bytes"


def _find_jpeg_damage(content: bytes) -> str | None:
    position = 2
    while position + 4 <= len(content):
        if content[position] != 0xFF:
            return f"JPEG is damaged at byte {position}"
        marker = content[position + 1]
        if marker == 0xFF or marker in _BARE_MARKERS:  # 0xFF: padding
            position += 1 if marker == 0xFF else 2
            continue
        length = int.from_bytes(content[position + 2 : position + 4], "big")
        if marker == 0xDA:
            # Inside the scans 0xFF is always followed by 0 or a restart marker, so this is the true end, not the end
            # of an embedded preview.
            if content.rfind(b"\xff\xd9") > position:
                return None
            break
        position += 2 + length
    return f"JPEG is truncated: no end marker in its {len(content)} bytes"
