# SPDX-License-Identifier: Apache-2.0
"""Frames between keyframes as training on a device sees them."""

from __future__ import annotations

from collections.abc import Hashable

import numpy as np
import torch

from ggslam.cuda.transfers import upload
from ggslam.mapping.between_frames import BetweenFrame
from ggslam.mapping.cuda.image_store import ImageStore
from ggslam.mapping.cuda.keyframe import CudaKeyframe, DeviceKeyframe
from ggslam.rendering.exposure import identity_exposure
from ggslam.scene.poses import inverse


class CudaBetweenView(DeviceKeyframe):
    """A keyframe without depth, with the number of the one that it hangs on. Its pose follows that one's on the device,
    and its image is decoded only when it is not there.

    Args:
        frame: between keyframes.
        keyframe: that it hangs on.
        images: of all keyframes.
        device: where.
    """

    def __init__(self, frame: BetweenFrame, keyframe: CudaKeyframe, images: ImageStore, device: torch.device) -> None:
        self._frame, self._keyframe, self._images = frame, keyframe, images
        self._T_camera_keyframe = upload(inverse(frame.T_keyframe_camera), device)
        self.index, self.frame_index, self.timestamp = keyframe.index, frame.frame_index, frame.timestamp
        self.camera, self.camera_number = keyframe.camera, keyframe.camera_number
        self.depth_unit, self.iterations = keyframe.depth_unit, 0
        self.mask = self.moving = self.archive = self.instant = None
        self.rows = []

    @property
    def color(self) -> np.ndarray:  # type: ignore[override]
        """uint8 [H, W, 3]. Raises FormatError as `BetweenFrame.view`."""
        return self._frame.decode(self._keyframe)

    @property
    def depth(self) -> np.ndarray:  # type: ignore[override]
        """None measured, uint16 [H, W]."""
        return np.zeros((self.camera.height, self.camera.width), np.uint16)

    @property
    def T_camera_world(self) -> np.ndarray:  # type: ignore[override]
        """float64 [4, 4], by its keyframe's as refined so far; may wait for the device."""
        return inverse(self._keyframe.T_world_camera @ self._frame.T_keyframe_camera)

    @property
    def exposure(self) -> np.ndarray:  # type: ignore[override]
        """The map's, [3, 2]."""
        return identity_exposure()

    @property
    def image_key(self) -> Hashable:
        return "between", self.frame_index

    @property
    def device_pose(self) -> torch.Tensor:
        return torch.mm(self._T_camera_keyframe, self._keyframe.exact_device_pose)[:3].float().view(12)

    @property
    def T_camera_keyframe_on_device(self) -> torch.Tensor | None:
        return self._T_camera_keyframe

    @property
    def has_depth(self) -> bool:
        return False
