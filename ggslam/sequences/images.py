# SPDX-License-Identifier: Apache-2.0
"""Colour, depth and confidence of a recording's image files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.arrays import read_array
from ggslam.sequences.recording import ImageFile, ImageSource
from ggslam.system.images import decode_image, read_image_bytes
from ggslam.system.opencv import opencv_errors

LARGEST_CODE: Final = 65535
"""Largest number of 16-bit depth images; it means that nothing was measured."""


def read_color(file: ImageFile, upright: bool = False) -> np.ndarray:
    """Colour image, uint8 [H, W, 3] RGB (grey images are spread over the three channels); may be read-only. `upright`:
    turned as the orientation tag of a photograph says.

    Raises:
        SequenceError: missing, truncated, or not an image.
    """
    if not isinstance(file, Path):
        return _read_source(file)
    return decode_color(file, read_image_bytes(file, SequenceError), upright)


def decode_color(name: object, content: bytes, upright: bool = False) -> np.ndarray:
    """Colour image uint8 [H, W, 3] RGB of the bytes of a PNG or JPEG file (`name` is for errors)."""
    # The orientation tag is ignored unless asked for: depth and calibration mostly refer to the pixels as stored.
    orientation = 0 if upright else cv2.IMREAD_IGNORE_ORIENTATION
    image = decode_image(name, content, cv2.IMREAD_COLOR | orientation, error=SequenceError)
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
        raw = _decode_file(file)
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
    return metric_depth(read_stored_depth(file), depth_scale, none)


def metric_depth(raw: np.ndarray, depth_scale: float, none: Iterable[float] = ()) -> np.ndarray:
    """The same of a depth image as stored."""
    depth = raw.astype(np.float32) / np.float32(depth_scale)
    if raw.dtype.kind == "f":
        depth[~((depth > 0) & np.isfinite(depth))] = 0
    else:
        depth[raw == LARGEST_CODE] = 0
    for code in none:
        depth[np.isclose(raw, code, rtol=1e-6, atol=0)] = 0
    return depth


def no_returns(raw: np.ndarray, none: Iterable[float] = ()) -> np.ndarray | None:
    """Where a depth image as stored says that the sensor found nothing within its range: +inf (REP 117; NaN and -inf
    say that nothing is known). Bool [H, W]; None: nowhere.

    Args:
        raw: uint16 or floating-point [H, W].
        none: stored numbers that mean "nothing measured" instead.
    """
    if raw.dtype.kind != "f" or np.inf in none:
        return None
    found = np.isposinf(raw)
    return found if found.any() else None


def read_confidence(file: ImageFile) -> np.ndarray:
    """Confidence levels uint8 [H, W]: 0 low, 1 medium, 2 high; may be read-only.

    Raises:
        SequenceError: missing, damaged, or not 8-bit with one channel.
    """
    image = _decode_file(file) if isinstance(file, Path) else _read_source(file)
    if image.ndim != 2 or image.dtype != np.uint8:
        raise SequenceError(f"{file}: expected an 8-bit confidence image, found {describe_channels(image)}")
    return image


def _decode_file(path: Path) -> np.ndarray:
    """The pixels of a PNG or JPEG file as they are stored."""
    return decode_image(path, read_image_bytes(path, SequenceError), cv2.IMREAD_UNCHANGED, error=SequenceError)


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
