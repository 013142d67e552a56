# SPDX-License-Identifier: Apache-2.0
"""Keyframes, and frames between them, whose poses, exposures and images are on a device."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Hashable
from dataclasses import fields
from typing import Final

import numpy as np
import torch

from ggslam.mapping.cuda.image_store import CudaKeyframeImages, ImageStore
from ggslam.mapping.cuda.keyframe_states import KeyframeStates
from ggslam.mapping.cuda.step_rows import KeptRow
from ggslam.mapping.keyframe import Keyframe
from ggslam.mapping.pixel_grid import ALL_PIXELS, PixelGrid

_FIELDS: Final = tuple(field.name for field in fields(Keyframe))


class DeviceKeyframe(Keyframe):
    """What training on a device reads of a keyframe, or of a frame between keyframes."""

    rows: list[KeptRow]
    _images: ImageStore

    @property
    @abstractmethod
    def image_key(self) -> Hashable:
        """What its images are kept by."""

    @property
    @abstractmethod
    def device_pose(self) -> torch.Tensor:
        """First three rows of its T_camera_world, float32 [12]. Nobody changes it before the next keyframe or step."""

    @property
    def T_camera_keyframe_on_device(self) -> torch.Tensor | None:
        """Its T_camera_keyframe on the device, float64 [4, 4], if its pose hangs on that of a keyframe."""
        return None

    @property
    def has_depth(self) -> bool:
        """Whether any depth was measured."""
        return True

    def device_images(self, grid: PixelGrid = ALL_PIXELS) -> CudaKeyframeImages:
        """On the device, what a step on a grid's pixels is compared with."""
        return self._images.of(self, grid)


class CudaKeyframe(DeviceKeyframe):
    """A keyframe whose pose and exposure are optimised on a device. Once it was trained, reading them waits for that.

    Args:
        keyframe: images, as the host keeps them, and the first pose and exposure.
        states: of all keyframes; this one gets the next row.
        images: of all keyframes.
    """

    def __init__(self, keyframe: Keyframe, states: KeyframeStates, images: ImageStore) -> None:
        self._states: KeyframeStates | None = None
        self._images, self.rows = images, []
        values = vars(keyframe)  # without images that are in an archive
        super().__init__(**{name: values[name] for name in _FIELDS})
        states.append(keyframe.T_camera_world, keyframe.exposure)
        self._states = states

    @property
    def T_camera_world(self) -> np.ndarray:  # type: ignore[override]
        """float64 [4, 4], as refined so far."""
        if self._states is None or self.iterations == 0:
            return self._given
        return self._states.read_poses()[self.index]

    @T_camera_world.setter
    def T_camera_world(self, T_camera_world: np.ndarray) -> None:
        self._given = np.array(T_camera_world, np.float64)
        if self._states is not None:
            self._states.write_pose(self.index, T_camera_world)

    @property
    def exposure(self) -> np.ndarray:  # type: ignore[override]
        """float64 [3, 2], as optimised so far."""
        assert self._states is not None
        return self._states.read_exposures()[self.index]

    @exposure.setter
    def exposure(self, exposure: np.ndarray) -> None:
        if self._states is not None:  # the first goes with the row
            self._states.write_exposure(self.index, exposure)

    @property
    def image_key(self) -> Hashable:
        return self.index

    @property
    def device_pose(self) -> torch.Tensor:
        assert self._states is not None
        return self._states.pose(self.index)

    @property
    def exact_device_pose(self) -> torch.Tensor:
        """T_camera_world on the device, float64 [4, 4]; valid until the next keyframe or step."""
        assert self._states is not None
        return self._states.exact_pose(self.index)

    @property
    def device_mask(self) -> torch.Tensor | None:
        """uint16 [H, W], as it is now; None without one."""
        return self._images.mask_of(self)
