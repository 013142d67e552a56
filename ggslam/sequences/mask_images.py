# SPDX-License-Identifier: Apache-2.0
"""Decoding the image of a mask: the number stored for each pixel, whichever way it is stored."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import cv2
import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.images import describe_channels
from ggslam.system.images import PNG_SIGNATURE, PictureLimits, decode_image, read_image_bytes
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import open_untrusted

MaskKind = Literal["grey", "palette", "RGB"]

EQUAL_CHANNELS: Final = 1 + 256 + 65536
"""A pixel whose three channels are v has the code v times this."""


class MaskTuning(Tuning):
    """Limits on the size of masks."""

    max_finer = 4
    """Most columns and rows of a mask, in columns and rows of the images."""
    small_pixels = 4_000_000
    """Pixels that a mask may have beside images of any size."""


_KINDS: dict[int, MaskKind] = {0: "grey", 2: "RGB", 3: "palette", 4: "RGB", 6: "RGB"}
"""PNG colour types; grey with alpha (4) is decoded to three equal channels and alpha."""
_HEADER_SIZE: Final = 29
"""Bytes of a PNG file up to the end of IHDR's data: signature, length, name, 13 bytes."""


@dataclass(frozen=True)
class MaskImage:
    """A mask as stored.

    Attributes:
        kind: how the file holds its numbers.
        codes: int32 [H, W]: the grey value or palette index, or R + 256 G + 65536 B.
        equal_channels: an RGB image with R = G = B everywhere: perhaps grey ids, `codes / EQUAL_CHANNELS`.
    """

    kind: MaskKind
    codes: np.ndarray
    equal_channels: bool = False


def mask_kind(path: Path) -> MaskKind | None:
    """How a file holds its ids, by its first bytes; None when it is no PNG or cannot be read."""
    try:
        with open_untrusted(path, SequenceError) as file:
            header = file.read(_HEADER_SIZE)
    except (OSError, SequenceError):
        return None
    return _format(header)[1]


def _format(content: bytes) -> tuple[int, MaskKind | None]:
    """Bits per channel and kind of a file that begins like this; (0, None) when it is no PNG."""
    if len(content) < _HEADER_SIZE or not content.startswith(PNG_SIGNATURE) or content[12:16] != b"IHDR":
        return 0, None
    return content[24], _KINDS.get(content[25])


def most_pixels(*sizes: tuple[int, int]) -> int:
    """Pixels that a mask may have beside images of these sizes (width, height): a black one of 100 megapixels is a
    small file, and would take 2 GB."""
    return max(
        MaskTuning.small_pixels, MaskTuning.max_finer**2 * max((width * height for width, height in sizes), default=0)
    )


def read_mask_image(path: Path, most: int = PictureLimits.max_pixels) -> MaskImage:
    """Reads a PNG of grey ids (1 to 16 bits), palette indices, or RGB-coded ids.

    Args:
        path: of the file.
        most: pixels that it may have, see `most_pixels`.

    Raises:
        SequenceError: missing, damaged, no PNG, of more pixels, RGB of more than 8 bits, or partly transparent.
    """
    content = read_image_bytes(path, SequenceError)
    bits, kind = _format(content)
    if kind is None:
        raise SequenceError(f"{path}: expected a PNG mask (a JPEG does not keep ids), found another kind of image")
    pixels = _pixels_only(content, as_grey=kind == "palette")
    raw = decode_image(path, pixels, cv2.IMREAD_UNCHANGED, most, SequenceError)
    if kind != "RGB":
        if raw.ndim != 2 or raw.dtype not in (np.uint8, np.uint16):
            raise SequenceError(f"{path}: expected one channel of ids, found {describe_channels(raw)}")
        # The decoder stretches 1, 2 and 4 bits to the range of 8.
        return MaskImage(kind, raw.astype(np.int32) // (255 // (2**bits - 1) if bits < 8 else 1))
    return _rgb_codes(path, raw)


def _rgb_codes(path: Path, raw: np.ndarray) -> MaskImage:
    if raw.ndim != 3 or raw.dtype != np.uint8:
        raise SequenceError(f"{path}: expected ids as grey values or 8-bit RGB, found {describe_channels(raw)}")
    if raw.shape[2] == 4 and not (raw[..., 3] == 255).all():
        raise SequenceError(f"{path}: expected a mask of ids, found a partly transparent picture")
    blue, green, red = (raw[..., channel] for channel in range(3))  # OpenCV's order
    codes = red.astype(np.int32) | (green.astype(np.int32) << 8) | (blue.astype(np.int32) << 16)
    return MaskImage("RGB", codes, equal_channels=bool((red == green).all() and (red == blue).all()))


def _pixels_only(content: bytes, as_grey: bool) -> bytes:
    """The PNG without palette, transparency and colour management, so that stored numbers come out as they are.

    `as_grey` also declares palette indices to be grey values: both are packed alike (PNG specification, 11.2.2).
    """
    parts = [PNG_SIGNATURE]
    for kind, data in _chunks(content):
        if kind == b"IHDR" and as_grey:
            data = data[:9] + b"\0" + data[10:]
        if kind in (b"IHDR", b"IDAT", b"IEND"):
            parts += [len(data).to_bytes(4, "big"), kind, data, zlib.crc32(kind + data).to_bytes(4, "big")]
    return b"".join(parts)


def _chunks(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """(kind, data) of the chunks of a PNG that is known to be whole."""
    position = len(PNG_SIGNATURE)
    while position + 12 <= len(content):
        end = position + 8 + int.from_bytes(content[position : position + 4], "big")
        yield content[position + 4 : position + 8], content[position + 8 : end]
        position = end + 4
