# SPDX-License-Identifier: Apache-2.0
"""Reading image files, with damage found rather than decoded.

OpenCV returns a half-grey picture for many truncated files and only prints a warning, so the containers are checked
first: every PNG chunk by its length and checksum, a JPEG by its end marker.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.arrays import read_array
from ggslam.sequences.recording import ImageFile, ImageSource
from ggslam.system.foreign import MAX_IMAGE_BYTES, read_foreign
from ggslam.system.opencv import opencv_errors

MAX_PIXELS = 100_000_000
"""Of one image: more than any camera of a recording has, and 300 MB in memory."""
LARGEST_CODE = 65535
"""Of 16-bit depth images: "nothing measured", or cut off there."""
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def read_color(file: ImageFile, upright: bool = False) -> np.ndarray:
    """Colour image, uint8 [H, W, 3] RGB (grey images are spread over the three channels); may be read-only. `upright`:
    turned as the orientation tag of a photograph says.

    Raises:
        SequenceError: missing, truncated, or not an image.
    """
    return decode_color(file, read_content(file), upright) if isinstance(file, Path) else _read_source(file)


def decode_color(name: object, content: bytes, upright: bool = False) -> np.ndarray:
    """Colour image uint8 [H, W, 3] RGB of the bytes of a PNG or JPEG file (`name` is for errors)."""
    # The orientation tag is ignored unless asked for: depth and calibration mostly refer to the pixels as stored.
    orientation = 0 if upright else cv2.IMREAD_IGNORE_ORIENTATION
    image = decode(name, content, cv2.IMREAD_COLOR | orientation)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_stored_depth(file: ImageFile) -> np.ndarray:
    """Depth image as stored: uint16 or floating-point [H, W], in the recording's units; may be read-only.

    Raises:
        SequenceError: as `read_depth`.
    """
    if not isinstance(file, Path):
        raw = _read_source(file)
    elif file.suffix.lower() == ".npy":
        raw = _read_array(file)
    else:
        raw = decode(file, read_content(file), cv2.IMREAD_UNCHANGED)
    if raw.ndim != 2 or (raw.dtype != np.uint16 and raw.dtype.kind != "f"):
        raise SequenceError(f"{file}: expected a 16-bit depth image with one channel, found {describe_channels(raw)}")
    return raw


def read_depth(file: ImageFile, depth_scale: float, none: Iterable[float] = ()) -> np.ndarray:
    """Depth image, float32 [H, W], metres, 0 where nothing was measured; may be read-only.

    Nothing was measured where 0 is stored, the largest number that 16 bits hold, a negative number, or none at all.

    Args:
        file: single-channel 16-bit PNG, or .npy of uint16 or floating-point numbers, or a source of either.
        depth_scale: units per metre.
        none: further stored numbers that mean "nothing measured".

    Raises:
        SequenceError: missing, truncated, not an image, or not 16-bit or floating-point with one channel.
    """
    raw = read_stored_depth(file)
    depth = raw.astype(np.float32) / np.float32(depth_scale)
    if raw.dtype.kind == "f":
        depth[~((depth > 0) & np.isfinite(depth))] = 0
    else:
        depth[raw == LARGEST_CODE] = 0
    for code in none:
        depth[np.isclose(raw, code, rtol=1e-6, atol=0)] = 0
    return depth


def read_confidence(file: ImageFile) -> np.ndarray:
    """Confidence levels uint8 [H, W]: 0 low, 1 medium, 2 high; may be read-only.

    Raises:
        SequenceError: missing, damaged, or not 8-bit with one channel.
    """
    image = decode(file, read_content(file), cv2.IMREAD_UNCHANGED) if isinstance(file, Path) else _read_source(file)
    if image.ndim != 2 or image.dtype != np.uint8:
        raise SequenceError(f"{file}: expected an 8-bit confidence image, found {describe_channels(image)}")
    return image


def _read_source(source: ImageSource) -> np.ndarray:
    """What a source gives. Pixels that OpenCV cannot convert are a fault of the recording."""
    with opencv_errors(source, SequenceError):
        return source.read()


def _read_array(path: Path) -> np.ndarray:
    array = read_array(path, SequenceError)
    if array.ndim not in (2, 3):
        raise SequenceError(f"{path}: expected an array of an image, found shape {list(np.shape(array))}")
    return array


def describe_channels(image: np.ndarray) -> str:
    """Channels and bits of an image, for messages."""
    channels = 1 if image.ndim == 2 else image.shape[2]
    kind = {"u": "integers", "i": "signed integers", "f": "floats"}.get(image.dtype.kind, str(image.dtype))
    return f"{channels} channel{'s' if channels > 1 else ''} of {8 * image.dtype.itemsize}-bit {kind}"


def read_content(path: Path) -> bytes:
    """The bytes of a PNG or JPEG file, whole.

    Raises:
        SequenceError: missing, truncated, damaged, or not an image.
    """
    content = read_foreign(path, MAX_IMAGE_BYTES, SequenceError)
    damage = find_damage(content)
    if damage:
        raise SequenceError(f"{path}: {damage}")
    return content


def decode(path: object, content: bytes, flags: int) -> np.ndarray:
    """Image of the bytes `content`, as OpenCV decodes it with `flags`; `path` is for errors.

    Raises:
        SequenceError: OpenCV cannot decode it.
    """
    size = claimed_size(content)
    if size is not None and size[0] * size[1] > MAX_PIXELS:
        raise SequenceError(f"{path}: claims {size[0]}x{size[1]} pixels; at most {MAX_PIXELS:,} are read")
    with opencv_errors(path, SequenceError):
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    if image is None:
        raise SequenceError(f"{path}: cannot be decoded as an image ({len(content)} bytes)")
    return image


def claimed_size(content: bytes) -> tuple[int, int] | None:
    """(width, height) that the header of a PNG or JPEG file claims; None where it has none."""
    if content.startswith(PNG_SIGNATURE):
        return int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big")
    position = 2
    while content.startswith(b"\xff\xd8") and position + 9 <= len(content) and content[position] == 0xFF:
        marker = content[position + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a frame's header
            height, width = content[position + 5 : position + 7], content[position + 7 : position + 9]
            return int.from_bytes(width, "big"), int.from_bytes(height, "big")
        padding = marker == 0xFF
        position += 1 if padding else 2 + int.from_bytes(content[position + 2 : position + 4], "big")
    return None


def find_damage(content: bytes) -> str | None:
    """What is wrong with the bytes of a PNG or JPEG file; None when nothing was found."""
    if not content:
        return "file is empty"
    if content.startswith(PNG_SIGNATURE):
        return _find_png_damage(content)
    if content.startswith(b"\xff\xd8"):
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
        if marker == 0xFF:  # padding
            position += 1
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
