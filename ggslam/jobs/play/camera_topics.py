# SPDX-License-Identifier: Apache-2.0
"""The topics of a camera: colour, depth and camera_info of frames as messages."""

from __future__ import annotations

from dataclasses import dataclass

from ggslam.messages.contents import Lens, Picture
from ggslam.messages.ros2_images import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    camera_info_message,
    compressed_message,
    image_message,
    with_infinity,
    with_stamp,
)
from ggslam.middleware.node import Node, Publisher, Qos
from ggslam.middleware.types import MessageTypes
from ggslam.scene.frame import Frame


@dataclass(frozen=True)
class TopicForm:
    """How a camera publishes. `prefix`: of its topics; `compressed`: as image_transport compresses; `metres`: depth as
    32FC1 instead of 16UC1, whole millimetres."""

    prefix: str = "camera"
    compressed: bool = False
    metres: bool = False


@dataclass(frozen=True)
class EncodedFrame:
    """Messages of a frame, CDR, whose time is still to be written."""

    color: bytes
    depth: bytes
    info: bytes

    @property
    def size(self) -> int:
        """Bytes."""
        return len(self.color) + len(self.depth) + len(self.info)


class CameraTopics:
    """Publishes frames as PREFIX/color, PREFIX/depth and PREFIX/camera_info; compressed images with the endings that
    image_transport gives them."""

    def __init__(self, node: Node, types: MessageTypes, form: TopicForm) -> None:
        self._types, self._form = types, form
        self._kind = COMPRESSED if form.compressed else IMAGE
        color, depth = ("/compressed", "/compressedDepth") if form.compressed else ("", "")
        self.color: Publisher = node.publisher(f"{form.prefix}/color{color}", self._kind, Qos())
        self.depth: Publisher = node.publisher(f"{form.prefix}/depth{depth}", self._kind, Qos())
        self.info: Publisher = node.publisher(f"{form.prefix}/camera_info", CAMERA_INFO, Qos())

    @property
    def publishers(self) -> tuple[Publisher, Publisher, Publisher]:
        """Of colour, depth and camera_info."""
        return self.color, self.depth, self.info

    @property
    def is_heard(self) -> bool:
        """Whether somebody listens to colour and somebody to depth."""
        return self.color.subscribers > 0 and self.depth.subscribers > 0

    def encode(self, frame: Frame) -> EncodedFrame:
        """The messages of a frame."""
        name = f"{self._form.prefix.strip('/').replace('/', '_')}_color_optical_frame"
        make = compressed_message if self._form.compressed else image_message
        depth = with_infinity(frame.depth, frame.no_return) if self._form.metres else frame.depth
        pictures = [
            self._types.encode(self._kind, make(self._types, Picture(name, image), 0.0, self._form.metres))
            for image in (frame.color, depth)
        ]
        info = self._types.encode(CAMERA_INFO, camera_info_message(self._types, Lens(name, frame.camera), 0.0))
        return EncodedFrame(pictures[0], pictures[1], info)

    def send(self, frame: EncodedFrame, stamp: float) -> None:
        """Publishes a frame, all of it taken at one time."""
        contents = (frame.info, frame.color, frame.depth)
        for publisher, content in zip((self.info, self.color, self.depth), contents, strict=True):
            publisher.send(with_stamp(content, stamp))
