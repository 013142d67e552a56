# SPDX-License-Identifier: Apache-2.0
"""The orientation tag of photographs: by which quarter turns, and mirrored or not, the camera held them."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from ggslam.errors import SequenceError
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import open_untrusted


class OrientationTuning(Tuning):
    """How much of an image file is read for its orientation."""

    head_bytes = 1 << 16
    """Bytes at the start of a file: the tag comes before the picture."""


ORIENTATION: Final = 0x0112
"""Number of the Exif tag "Orientation"."""
WORDS = {
    2: "mirrored", 3: "turned by 180 degrees", 4: "upside down and mirrored", 5: "turned by 90 degrees and mirrored",
    6: "turned by 90 degrees", 7: "turned by 270 degrees and mirrored", 8: "turned by 270 degrees",
}  # fmt: skip
"""How the pixels of a file with each tag lie; 1 is upright (CIPA DC-008, Exif 2.32, table 6)."""

QUARTER_TURNS: Final = (5, 6, 7, 8)
"""Its values that exchange width and height."""


def orientation_of(file: object) -> int:
    """The tag of a JPEG file, 1 to 8; 1 where there is none, and of images that are no file of their own."""
    if not isinstance(file, Path) or file.suffix.lower() not in (".jpg", ".jpeg"):
        return 1
    try:
        with open_untrusted(file, SequenceError) as opened:
            return orientation_in(opened.read(OrientationTuning.head_bytes))
    except (OSError, SequenceError):
        return 1


def orientation_in(content: bytes) -> int:
    """The tag in the first bytes of a JPEG file; 1 where there is none."""
    position = 2
    while content.startswith(b"\xff\xd8") and position + 4 <= len(content) and content[position] == 0xFF:
        marker, length = content[position + 1], int.from_bytes(content[position + 2 : position + 4], "big")
        if marker == 0xDA or length < 2:
            break
        segment = content[position + 4 : position + 2 + length]
        if marker == 0xE1 and segment.startswith(b"Exif\0\0"):
            return _tag(segment[6:])
        position += 2 + length
    return 1


def _tag(tiff: bytes) -> int:
    """The orientation in the first directory of a TIFF header."""
    order = {b"II": "little", b"MM": "big"}.get(tiff[:2])
    if order is None:
        return 1
    whole = lambda at, size: int.from_bytes(tiff[at : at + size], order)  # type: ignore[arg-type]  # noqa: E731
    directory = whole(4, 4)
    for entry in range(whole(directory, 2)):
        at = directory + 2 + 12 * entry
        if at + 12 > len(tiff):
            break
        if whole(at, 2) == ORIENTATION:
            value = whole(at + 8, 2)
            return value if 1 <= value <= 8 else 1
    return 1
