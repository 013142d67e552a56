# SPDX-License-Identifier: Apache-2.0
"""Images in ROS messages: sensor_msgs/Image, CompressedImage, and depth by compressed_depth_image_transport."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.images import decode_color
from ggslam.system.images import PNG_SIGNATURE, decode_image, find_damage

COLOR: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None), "8uc3": (3, cv2.COLOR_BGR2RGB), "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB), "bgra8": (4, cv2.COLOR_BGRA2RGB), "8uc4": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB), "8uc1": (1, cv2.COLOR_GRAY2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY), "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2), "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB), "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB), "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
}  # fmt: skip
"""Encoding -> bytes a pixel and OpenCV's conversion to RGB."""
DEPTH: dict[str, Any] = {"16uc1": np.dtype(np.uint16), "mono16": np.dtype(np.uint16), "32fc1": np.dtype(np.float32)}
"""Encoding -> numbers; uint16 are millimetres, float32 metres (REP 118)."""


def pixel_encoding(message: Any) -> str:
    """How an image message says that its pixels are stored."""
    return str(message.encoding if hasattr(message, "encoding") else message.format)


def is_depth(message: Any) -> bool | None:
    """Whether an image message holds depth; None: neither depth nor colour that is known."""
    encoding = pixel_encoding(message).lower()
    if hasattr(message, "encoding"):
        return True if encoding in DEPTH else False if encoding in COLOR else None
    if _is_grey_16_bit_png(bytes(message.data[:32])):  # whatever its format says, as plain "png"
        return True
    if not any(depth in encoding for depth in (*DEPTH, "compresseddepth")):
        return False
    return True if any(way in encoding for way in ("compresseddepth", "png")) else None  # JPEG has 8 bits


def _is_grey_16_bit_png(start: bytes) -> bool:
    """By the header: bit depth and colour type stand behind width and height."""
    return start.startswith(PNG_SIGNATURE) and start[24:26] == bytes([16, 0])


def in_metres(message: Any) -> bool:
    """Whether a depth message holds metres (else millimetres)."""
    encoding = pixel_encoding(message).lower()
    return "32fc1" in encoding and (hasattr(message, "encoding") or "compresseddepth" in encoding)


def depth_in_unit(place: str, message: Any, metres: bool) -> np.ndarray:
    """Depth of an image message in metres or millimetres, whichever it holds: some bags change the encoding midway.
    float32 or uint16 [H, W]; errors as `depth_image`."""
    depth = depth_image(place, message)
    if (depth.dtype.kind == "f") == metres:
        return depth
    return depth.astype(np.float32) * np.float32(1e-3 if metres else 1e3)


def color_image(place: str, message: Any) -> np.ndarray:
    """Colour uint8 [H, W, 3] RGB of an image message, read-only where it is a view of it.

    Raises:
        SequenceError: it is damaged or not colour.
    """
    if not hasattr(message, "encoding"):
        content = bytes(message.data)
        damage = find_damage(content)
        if damage:
            raise SequenceError(f"{place}: {damage}")
        return decode_color(place, content)
    encoding = message.encoding.lower()
    if encoding not in COLOR:
        raise SequenceError(
            f"{place}: encoding {message.encoding} is not a supported colour encoding ({', '.join(COLOR)})"
        )
    if COLOR[encoding][0] == 2 and message.width % 2:
        raise SequenceError(f"{place}: {message.encoding} needs images of even width, found {message.width}")
    channels, conversion = COLOR[encoding]
    image = _rows(place, message, np.dtype(np.uint8), channels)
    if conversion is None:
        return np.ascontiguousarray(image)
    return cv2.cvtColor(np.ascontiguousarray(image if channels > 1 else image[..., 0]), conversion)


def depth_image(place: str, message: Any) -> np.ndarray:
    """Depth of an image message, uint16 (millimetres) or float32 (metres) [H, W], read-only where it is a view of it.

    Raises:
        SequenceError: it is damaged or not depth.
    """
    if not hasattr(message, "encoding"):
        return _compressed_depth(place, message)
    encoding = message.encoding.lower()
    if encoding not in DEPTH:
        raise SequenceError(
            f"{place}: encoding {message.encoding} is not a supported depth encoding ({', '.join(DEPTH)})"
        )
    dtype = DEPTH[encoding].newbyteorder(">" if message.is_bigendian else "<")
    return np.ascontiguousarray(_rows(place, message, dtype, 1)[..., 0]).astype(dtype.newbyteorder("="), copy=False)


def _rows(place: str, message: Any, dtype: np.dtype, channels: int) -> np.ndarray:
    """Pixels [H, W, channels] without the padding at the end of each row."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(bytes(message.data), np.uint8)
    used = width * channels * dtype.itemsize
    what = f"{width}x{height} pixels of {message.encoding}"
    if height < 1 or width < 1:
        raise SequenceError(f"{place}: an image of {what} is none")
    if step < used:
        raise SequenceError(f"{place}: {what} need rows of {used} bytes, found rows of {step} (step)")
    if data.size < height * step:
        raise SequenceError(
            f"{place}: {what} in rows of {step} bytes (step) need {height * step} bytes, found {data.size} (truncated?)"
        )
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :used])
    return rows.view(dtype).reshape(height, width, channels)


def _compressed_depth(place: str, message: Any) -> np.ndarray:
    """Of compressed_depth_image_transport, whose 12 bytes before the PNG tell how float32 depth was turned into 16
    bits, A / depth + B; or of compressed_image_transport, a PNG of millimetres alone."""
    form, content = message.format.lower(), bytes(message.data)
    if "rvl" in form:
        raise SequenceError(f"{place}: depth as '{message.format}' (RVL) is not supported; republish it as PNG")
    head = 12 if "compresseddepth" in form else 0
    if len(content) <= head:
        raise SequenceError(f"{place}: compressed depth of {len(content)} bytes is truncated")
    damage = find_damage(content[head:])
    if damage:
        raise SequenceError(f"{place}: {damage}")
    raw = decode_image(place, content[head:], cv2.IMREAD_UNCHANGED, error=SequenceError)
    if raw.ndim != 2 or raw.dtype != np.uint16:
        raise SequenceError(f"{place}: expected a 16-bit image in compressed depth")
    if "32fc1" not in form or not head:
        return raw
    a, b = struct.unpack("<ff", content[4:12])
    depth = np.zeros(raw.shape, np.float32)
    np.divide(np.float32(a), raw.astype(np.float32) - np.float32(b), out=depth, where=raw > 0)
    return depth
