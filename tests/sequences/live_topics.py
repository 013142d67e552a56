# SPDX-License-Identifier: Apache-2.0
"""Topics of a camera on a network in memory, published message by message."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from ggslam.messages.contents import Lens, Picture
from ggslam.messages.ros2_images import camera_info_message, compressed_message, image_message
from ggslam.middleware.node import LATCHED, Node, Qos
from ggslam.middleware.types import message_types
from ggslam.scene.camera import Camera
from ggslam.sequences.formats.ros2_discovery import wait_until

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
INFO, TF = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
ADDRESS, PATIENT = (f"ros2://camera/color,camera/depth?wait={seconds}" for seconds in (0.8, 5))


def color_of(i: int, camera: Camera = CAMERA) -> np.ndarray:
    """RGB, uint8, smooth: what JPEG is made for."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    waves = [128 + 100 * np.sin(u / 9 + i), 128 + 100 * np.cos(v / 8 + i), 128 + 80 * np.sin((u + v) / 12)]
    return np.rint(np.stack(waves, -1)).astype(np.uint8)


def depth_of(i: int, camera: Camera = CAMERA) -> np.ndarray:
    """Metres, whole millimetres; the first row is none."""
    depth = np.random.default_rng(100 + i).integers(300, 9001, (camera.height, camera.width)) / np.float32(1000)
    depth[0] = 0
    return depth.astype(np.float32)


class TopicCamera:
    """Publishes color, depth and camera_info under `prefix`."""

    def __init__(
        self, node: Node, prefix: str = "/camera", compressed: bool = False, metres: bool = False,
        qos: Qos | None = None, camera: Camera = CAMERA,
    ) -> None:  # fmt: skip
        self.types, self.node, self.camera = message_types(), node, camera
        self.compressed, self.metres = compressed, metres
        self.kind = COMPRESSED if compressed else IMAGE
        ends = ("/compressed", "/compressedDepth") if compressed else ("", "")
        qos = qos or Qos()
        self.color = node.publisher(f"{prefix}/color{ends[0]}", self.kind, qos)
        self.depth = node.publisher(f"{prefix}/depth{ends[1]}", self.kind, qos)
        self.info = node.publisher(f"{prefix}/camera_info", INFO, qos)
        self.fixed = node.publisher("/tf_static", TF, LATCHED)
        self.frames = ("color_optical", "color_optical")

    def send_info(self, stamp: float = 1.0, camera: Camera | None = None) -> None:
        message = camera_info_message(self.types, Lens(self.frames[0], camera or self.camera), stamp)
        self.info.send(self.types.encode(INFO, message))

    def message(self, which: str, i: int, stamp: float) -> bytes:
        make: Any = compressed_message if self.compressed else image_message
        image = color_of(i, self.camera) if which == "color" else depth_of(i, self.camera)
        frame = self.frames[which == "depth"]
        return self.types.encode(self.kind, make(self.types, Picture(frame, image), stamp, self.metres))

    def send_later(self, i: int, stamp: float, depth_after: float = 0.0) -> None:
        """Sends frame i, and its camera, once somebody has subscribed."""

        def send() -> None:
            wait_until(lambda: self.info.subscribers > 0, 2.0)
            self.send_info()
            self.send(i, stamp, depth_after)

        threading.Thread(target=send, daemon=True).start()

    def send(self, i: int, stamp: float, depth_after: float = 0.0) -> None:
        self.color.send(self.message("color", i, stamp))
        self.depth.send(self.message("depth", i, stamp + depth_after))
