# SPDX-License-Identifier: Apache-2.0
"""Pictures and cameras as messages of sensor_msgs: Image, CompressedImage (image_transport) and CameraInfo."""

from __future__ import annotations

import struct
from typing import Any, Final

import cv2
import numpy as np

from ggslam.messages.contents import Lens, Picture
from ggslam.messages.stamps import seconds_and_nanoseconds
from ggslam.middleware.types import MessageTypes
from ggslam.system.tuning import Tuning

IMAGE: Final = "sensor_msgs/msg/Image"
COMPRESSED: Final = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO: Final = "sensor_msgs/msg/CameraInfo"
MM_PER_M: Final = 1000.0
"""16-bit depth is in millimetres (REP 118)."""
LARGEST_MM: Final = 65534
"""Largest depth in millimetres that is sent: 65535 stands for "nothing measured" in many cameras."""


class PictureTuning(Tuning):
    """How pictures are compressed."""

    jpeg_quality = 95
    """Of colour, 0 to 100."""
    png_level = 1
    """Of depth, 0 to 9: more takes several times as long and saves a few per cent."""
    quantised_m = 100.0
    """Metres of the parameter A in A / depth + B by which float depth becomes 16 bits: compressed_depth_image_transport
    takes it from its depth_quantization, of which this is the default."""
    farthest_m = 10.0
    """Its depth_max: what is farther is left out."""


def stamp_of(types: MessageTypes, seconds: float) -> Any:
    """builtin_interfaces/Time of a time in seconds."""
    whole, nanoseconds = seconds_and_nanoseconds(seconds)
    return types.make("builtin_interfaces/msg/Time", sec=whole, nanosec=nanoseconds)


def header(types: MessageTypes, frame: str, seconds: float) -> Any:
    """std_msgs/Header."""
    return types.make("std_msgs/msg/Header", stamp=stamp_of(types, seconds), frame_id=frame)


def depth_mm(depth: np.ndarray) -> np.ndarray:
    """Depth float32 [H, W], metres -> uint16 millimetres, rounded; 0 where there is none, or more than fits."""
    units = np.rint(np.nan_to_num(depth, nan=0.0, posinf=0.0, neginf=0.0) * np.float32(MM_PER_M))
    return np.where((units > 0) & (units <= LARGEST_MM), units, 0).astype(np.uint16)


def image_message(types: MessageTypes, picture: Picture, stamp: float, in_metres: bool = False) -> Any:
    """sensor_msgs/Image: colour as rgb8; depth as 16UC1, millimetres, or 32FC1, metres and NaN where there is none."""
    image = picture.image
    if image.ndim == 3:
        encoding, stored = "rgb8", image
    elif in_metres:
        encoding, stored = "32FC1", np.where(image > 0, image, np.float32(np.nan)).astype("<f4")
    else:
        encoding, stored = "16UC1", depth_mm(image).astype("<u2")
    rows = np.frombuffer(np.ascontiguousarray(stored).tobytes(), np.uint8)
    return types.make(
        IMAGE, header=header(types, picture.frame, stamp), height=image.shape[0], width=image.shape[1],
        encoding=encoding, is_bigendian=0, step=len(rows) // image.shape[0], data=rows,
    )  # fmt: skip


def compressed_message(types: MessageTypes, picture: Picture, stamp: float, in_metres: bool = False) -> Any:
    """sensor_msgs/CompressedImage: colour as JPEG, depth as compressed_depth_image_transport writes 16UC1 or 32FC1."""
    image = picture.image
    if image.ndim == 3:
        form = "rgb8; jpeg compressed bgr8"
        options = [cv2.IMWRITE_JPEG_QUALITY, PictureTuning.jpeg_quality]
        content = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)[1].tobytes()
    elif in_metres:
        form, content = "32FC1; compressedDepth png", _inverse_depth(image)
    else:
        form, content = "16UC1; compressedDepth png", struct.pack("<iff", 0, 0.0, 0.0) + _png(depth_mm(image))
    return types.make(
        COMPRESSED, header=header(types, picture.frame, stamp), format=form, data=np.frombuffer(content, np.uint8)
    )


def _inverse_depth(depth: np.ndarray) -> bytes:
    """The head of 12 bytes and a PNG of A / depth + B, which is finer near by."""
    a = PictureTuning.quantised_m * (PictureTuning.quantised_m + 1.0)
    b = 1.0 - a / PictureTuning.farthest_m
    known = np.isfinite(depth) & (depth > 0) & (depth < PictureTuning.farthest_m)
    coded = np.where(known, a / np.where(known, depth, 1.0) + b, 0.0)
    coded = np.where(coded <= LARGEST_MM, coded, 0.0)
    return struct.pack("<iff", 0, a, b) + _png(coded.astype(np.uint16))


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, PictureTuning.png_level])[1].tobytes()


def camera_info_message(types: MessageTypes, lens: Lens, stamp: float) -> Any:
    """sensor_msgs/CameraInfo of a camera without distortion."""
    camera = lens.camera
    K = camera.matrix()
    region = types.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return types.make(
        CAMERA_INFO, header=header(types, lens.frame, stamp), height=camera.height, width=camera.width,
        distortion_model="plumb_bob", d=np.zeros(5), k=K.reshape(-1), r=np.eye(3).reshape(-1),
        p=np.hstack([K, np.zeros((3, 1))]).reshape(-1), binning_x=0, binning_y=0, roi=region,
    )  # fmt: skip
