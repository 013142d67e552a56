# SPDX-License-Identifier: Apache-2.0
"""Transforms, poses, paths, lenses and pictures in Foxglove's schemas. All functions return protobuf."""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.messages.contents import Lens, Path, Picture, Pose
from ggslam.messages.foxglove_package import foxglove_messages, pose, quaternion, timestamp, vector
from ggslam.messages.pose_numbers import position_and_quaternion
from ggslam.messages.protobuf_rows import pose_rows
from ggslam.messages.ros2_images import PictureTuning, depth_mm
from ggslam.messages.sound_content import plain_text

Edge = tuple[str, str, np.ndarray, float]
"""Parent, child, T_parent_child, stamp."""


def transforms_message(edges: list[Edge]) -> bytes:
    """foxglove.FrameTransforms."""
    kinds = foxglove_messages()
    made = []
    for parent, child, T, stamp in edges:
        numbers = position_and_quaternion(T)
        made.append(
            kinds.FrameTransform(
                timestamp=timestamp(stamp), parent_frame_id=plain_text(parent), child_frame_id=plain_text(child),
                translation=vector(numbers[:3]), rotation=quaternion(numbers[3:]),
            )
        )  # fmt: skip
    return bytes(kinds.FrameTransforms(transforms=made).encode())


def pose_message(content: Pose, stamp: float) -> bytes:
    """foxglove.PoseInFrame."""
    kinds = foxglove_messages()
    made = kinds.PoseInFrame(timestamp=timestamp(stamp), frame_id=plain_text(content.frame), pose=pose(content.T))
    return bytes(made.encode())


def path_message(content: Path, stamp: float) -> bytes:
    """foxglove.PosesInFrame, which has no stamps of the poses."""
    head = foxglove_messages().PosesInFrame(timestamp=timestamp(stamp), frame_id=plain_text(content.frame))
    return bytes(head.encode()) + pose_rows(3, position_and_quaternion(content.poses))


def lens_message(content: Lens, stamp: float) -> bytes:
    """foxglove.CameraCalibration of a camera without distortion."""
    camera = content.camera
    K = camera.matrix()
    made = foxglove_messages().CameraCalibration(
        timestamp=timestamp(stamp), frame_id=plain_text(content.frame), width=camera.width, height=camera.height,
        distortion_model="plumb_bob", D=[0.0] * 5, K=K.ravel().tolist(), R=np.eye(3).ravel().tolist(),
        P=np.hstack([K, np.zeros((3, 1))]).ravel().tolist(),
    )  # fmt: skip
    return bytes(made.encode())


def picture_message(content: Picture, stamp: float) -> bytes:
    """foxglove.CompressedImage, as a topic has one schema: JPEG of colour, or PNG if it shall not be compressed with
    loss; PNG of millimetres of depth."""
    png = [cv2.IMWRITE_PNG_COMPRESSION, PictureTuning.png_level]
    if content.image.ndim == 2:
        form, stored, options = "png", depth_mm(content.image), png
    else:
        jpeg = [cv2.IMWRITE_JPEG_QUALITY, PictureTuning.jpeg_quality]
        form, options = ("jpeg", jpeg) if content.compressed else ("png", png)
        stored = cv2.cvtColor(content.image, cv2.COLOR_RGB2BGR)
    data = cv2.imencode(f".{form}", stored, options)[1].tobytes()
    made = foxglove_messages().CompressedImage(
        timestamp=timestamp(stamp), frame_id=plain_text(content.frame), data=data, format=form
    )
    return bytes(made.encode())
