# SPDX-License-Identifier: Apache-2.0
"""Bags of one encoding each, in every storage that ROS 1 and ROS 2 have, written by the package rosbags; the pixels of
an encoding are laid out here by the definitions of sensor_msgs/image_encodings, without the reader's code."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from format_makers import BagMessages

WIDTH, HEIGHT = 32, 24
STORAGES = (
    "ros1", "ros1 bz2", "ros1 lz4", "sqlite3", "sqlite3 file", "sqlite3 message", "mcap", "mcap file", "mcap message",
    "mcap chunks zstd", "mcap chunks lz4",
)  # fmt: skip
"""ROS 1 by the compression of its chunks; ROS 2 by storage and what of it is compressed with zstd, if nothing else is
said."""
COLOR_TOPIC, DEPTH_TOPIC = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"


def picture(i: int) -> np.ndarray:
    """RGB, every pixel of another colour."""
    return np.random.default_rng(i).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)


def smooth_picture(i: int) -> np.ndarray:
    """RGB, uint8: what JPEG is made for."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    waves = [128 + 100 * np.sin(u / 9 + i), 128 + 100 * np.cos(v / 8 + i), 128 + 80 * np.sin((u + v) / 12)]
    return np.rint(np.stack(waves, -1)).astype(np.uint8)


def depth_mm(i: int) -> np.ndarray:
    """uint16: 0, and all from 300 to 9000."""
    depth = np.random.default_rng(100 + i).integers(300, 9001, (HEIGHT, WIDTH)).astype(np.uint16)
    depth[:2] = 0
    return depth


def grey(rgb: np.ndarray) -> np.ndarray:
    return rgb[..., 1].copy()


def with_alpha(pixels: np.ndarray) -> np.ndarray:
    return np.dstack([pixels, np.full(pixels.shape[:2], 77, np.uint8)])


def bayer(rgb: np.ndarray, pattern: str) -> np.ndarray:
    """One number a pixel, through the filter that `pattern` names row by row of its four pixels."""
    mosaic = np.empty(rgb.shape[:2], np.uint8)
    for k, letter in enumerate(pattern):
        row, column = divmod(k, 2)
        mosaic[row::2, column::2] = rgb[row::2, column::2, "rgb".index(letter)]
    return mosaic


def yuv(rgb: np.ndarray) -> np.ndarray:
    """Y, U, V by ITU-R BT.601 with its small range, uint8; U and V of two pixels beside each other are the first's."""
    r, g, b = (rgb[..., k].astype(float) / 255 for k in range(3))
    y = 0.299 * r + 0.587 * g + 0.114 * b
    planes = [16 + 219 * y, 128 + 224 * (b - y) / 1.772, 128 + 224 * (r - y) / 1.402]
    out = np.rint(np.stack(planes, -1)).astype(np.uint8)
    out[:, 1::2, 1:] = out[:, ::2, 1:]
    return out


def rgb_of(yuv_pixels: np.ndarray) -> np.ndarray:
    """RGB in float, 0 to 255, of what `yuv` gives."""
    y, u, v = np.moveaxis((yuv_pixels - np.array([16.0, 128, 128])) / (219, 224, 224), -1, 0)
    r, b = y + 1.402 * v, y + 1.772 * u
    return np.clip(255 * np.stack([r, (y - 0.299 * r - 0.114 * b) / 0.587, b], -1), 0, 255)


def interleaved(rgb: np.ndarray, luma_first: bool) -> np.ndarray:
    """Two bytes a pixel: Y U Y V, or U Y V Y."""
    pixels = yuv(rgb)
    chroma = pixels[..., 1].copy()
    chroma[:, 1::2] = pixels[:, 1::2, 2]
    both = (pixels[..., 0], chroma)
    return np.stack(both if luma_first else both[::-1], -1)


LAYOUTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "rgb8": np.array, "bgr8": lambda p: p[..., ::-1], "8UC3": lambda p: p[..., ::-1],
    "rgba8": with_alpha, "bgra8": lambda p: with_alpha(p[..., ::-1]), "8UC4": lambda p: with_alpha(p[..., ::-1]),
    "mono8": grey, "8UC1": grey,
    "yuv422": lambda p: interleaved(p, False), "uyvy": lambda p: interleaved(p, False),
    "yuv422_yuy2": lambda p: interleaved(p, True), "yuyv": lambda p: interleaved(p, True),
    **{f"bayer_{name}8": lambda p, name=name: bayer(p, name) for name in ("rggb", "bggr", "gbrg", "grbg")},
}  # fmt: skip
"""Encoding -> array [H, W] or [H, W, channels] of RGB pixels."""
LOSSLESS = tuple(name for name in LAYOUTS if not name.startswith(("mono", "8UC1", "y", "u", "bayer")))


class ImageMessages(BagMessages):
    """Messages of any encoding."""

    def __init__(self, ros2: bool) -> None:
        super().__init__(ros2, False, False)

    def raw_image(self, time: float, encoding: str, pixels: np.ndarray, padding: int = 0, big: bool = False) -> Any:
        """sensor_msgs/Image with `padding` bytes of 0xAB behind each row, in big-endian numbers if `big`."""
        stored = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))
        rows = np.frombuffer(stored.tobytes(), np.uint8).reshape(pixels.shape[0], -1)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=0xAB)
        return self.types["Image"](
            header=self.header(time, "color_optical"), height=pixels.shape[0], width=pixels.shape[1],
            encoding=encoding, is_bigendian=int(big), step=rows.shape[1], data=rows.reshape(-1).copy(),
        )  # fmt: skip

    def compressed_image(self, time: float, form: str, content: bytes) -> Any:
        data = np.frombuffer(content, np.uint8)
        return self.types["CompressedImage"](header=self.header(time, "color_optical"), format=form, data=data)


def as_png(pixels: np.ndarray) -> bytes:
    """Of RGB or one channel."""
    return cv2.imencode(".png", pixels[..., ::-1] if pixels.ndim == 3 else pixels)[1].tobytes()


def compressed_depth(metres: bool, depth: np.ndarray, a: float = 10100.0, b: float = -1009.0) -> bytes:
    """As compressed_depth_image_transport writes it: a head of 12 bytes, then a PNG of millimetres, or of a/z + b."""
    if not metres:
        return struct.pack("<iff", 0, 0, 0) + as_png(depth)
    with np.errstate(divide="ignore"):
        coded = np.where(depth > 0, a / (depth / 1000.0) + b, 0).astype(np.uint16)
    return struct.pack("<iff", 0, a, b) + as_png(coded)


def write_image_bag(
    folder: Path, storage: str, colors: Callable[[ImageMessages, float, int], Any],
    depths: Callable[[ImageMessages, float, int], Any], count: int = 3, info: bool = True,
    size: tuple[int, int] = (WIDTH, HEIGHT), region: tuple[int, int] | None = None,
) -> Path:  # fmt: skip
    """A bag with `count` pairs of images, 1/30 s apart; `colors` and `depths` make message i at a time; with
    a region the images are the part of the sensor that begins there."""
    ros2 = not storage.startswith("ros1")
    messages = ImageMessages(ros2)
    sent: list[tuple[str, float, Any]] = []
    if info:
        calibration = messages.info("color_optical", (), "plumb_bob")
        calibration.width, calibration.height = size
        if region is not None:
            roi = calibration.roi
            (roi.x_offset, roi.y_offset), roi.width, roi.height = region, WIDTH, HEIGHT
        sent += [(f"{topic.rsplit('/', 1)[0]}/camera_info", 999.9, calibration) for topic in (COLOR_TOPIC, DEPTH_TOPIC)]
    for i in range(count):
        time = 1000 + i / 30
        for topic, make in ((COLOR_TOPIC, colors), (DEPTH_TOPIC, depths)):
            message = make(messages, time, i)
            suffix = "" if hasattr(message, "encoding") else _suffix(message)
            sent.append((topic + suffix, time, message))
    path = folder / ("walk" if ros2 else "walk.bag")
    _write(path, storage, messages, sent)
    return path


def _suffix(message: Any) -> str:
    return "/compressedDepth" if "compressedDepth" in message.format else "/compressed"


def _write(path: Path, storage: str, messages: ImageMessages, sent: Iterable[tuple[str, float, Any]]) -> None:
    with _writer(path, storage) as writer:
        if storage.endswith("lz4") and messages.ros2:  # the package writes zstd, and reads both
            lz4 = pytest.importorskip("lz4.frame")
            writer.storage.compression, writer.storage.compressor = "lz4", lz4.compress
        connections: dict[str, Any] = {}
        for topic, time, message in sent:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=messages.store)
            writer.write(connections[topic], round((time + 0.2) * 1e9), messages.raw(kind, message))


def _writer(path: Path, storage: str) -> Any:
    if storage.startswith("ros1"):
        module = pytest.importorskip("rosbags.rosbag1")
        writer = module.Writer(path)
        if storage != "ros1":
            writer.set_compression(module.Writer.CompressionFormat[storage.split()[1].upper()])
        return writer
    module = pytest.importorskip("rosbags.rosbag2")
    kind, _, compressed = storage.partition(" ")
    writer = module.Writer(path, version=9, storage_plugin=module.StoragePlugin[kind.upper()])
    if compressed:
        mode = "STORAGE" if compressed.startswith("chunks") else compressed.upper()
        writer.set_compression(module.CompressionMode[mode], module.CompressionFormat.ZSTD)
    return writer
