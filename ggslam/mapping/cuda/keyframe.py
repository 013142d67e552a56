# SPDX-License-Identifier: Apache-2.0
"""Keyframes, and frames between them, whose poses, exposures and images are on a device."""

from __future__ import annotations

from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass, fields

import numpy as np
import torch

from ggslam.cuda.transfers import upload
from ggslam.mapping.cuda.keyframe_states import KeyframeStates
from ggslam.mapping.keyframe import Keyframe
from ggslam.mapping.pixel_grid import ALL_PIXELS, PixelGrid
from ggslam.system.tuning import Tuning


class DeviceImageTuning(Tuning):
    """Images of keyframes on a GPU."""

    max_bytes = 512_000_000
    """Most bytes of images kept on the device. The least recently used ones are dropped and uploaded again."""


@dataclass
class CudaKeyframeImages:
    """Images of a keyframe.

    Attributes:
        color: uint8 [H, W, 3].
        depth: uint16 [H, W], see `Keyframe`.
        depth_of: the array that it was uploaded from; None: one that does not change.
        mask: uint16 [H, W], uploaded when first asked for.
        mask_of: the array that it was uploaded from.
    """

    color: torch.Tensor
    depth: torch.Tensor
    depth_of: np.ndarray | None = None
    mask: torch.Tensor | None = None
    mask_of: np.ndarray | None = None

    @property
    def nbytes(self) -> int:
        """Memory that they take."""
        return sum(image.nbytes for image in (self.color, self.depth, self.mask) if image is not None)


class DeviceKeyframe(Keyframe):
    """What training on a device reads of a keyframe, or of a frame between keyframes."""

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
        self._images = images
        values = vars(keyframe)  # without images that are in an archive
        super().__init__(**{field.name: values[field.name] for field in fields(Keyframe)})
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


class ImageStore:
    """Images of keyframes on a device, no more than there is room for.

    Args:
        device: where.
        limit: bytes.
    """

    def __init__(self, device: torch.device, limit: int = DeviceImageTuning.max_bytes) -> None:
        self._device, self._limit = device, limit
        self._images: OrderedDict[Hashable, CudaKeyframeImages] = OrderedDict()
        self._nothing: dict[tuple[int, ...], torch.Tensor] = {}  # depth of frames without any, by size
        self.nbytes = 0
        """Memory that they take at present."""

    def of(self, keyframe: DeviceKeyframe, grid: PixelGrid = ALL_PIXELS) -> CudaKeyframeImages:
        """Those of a keyframe at a grid's pixels, uploaded if need be."""
        key = keyframe.image_key if grid.is_whole else (keyframe.image_key, grid)
        images, depth_now = self._images.pop(key, None), vars(keyframe).get("depth")  # one in an archive never changes
        if images is not None and depth_now is not None and images.depth_of is not depth_now:
            self.nbytes -= images.nbytes
            images.depth, images.depth_of = self._upload(grid.depth_of(depth_now)), depth_now
            self.nbytes += images.nbytes
        if images is None:
            color = self._upload(grid.color_of(keyframe.color))
            depth = self._no_depth(color) if not keyframe.has_depth else self._upload(grid.depth_of(keyframe.depth))
            images = CudaKeyframeImages(color, depth, depth_now)
            self.nbytes += images.nbytes
        self._images[key] = images  # the one used last stands last
        self._make_room()
        return images

    def mask_of(self, keyframe: DeviceKeyframe) -> torch.Tensor | None:
        """The mask that a keyframe has now."""
        mask = keyframe.mask
        if mask is None:
            return None
        images = self.of(keyframe)
        if images.mask is None or images.mask_of is not mask:
            self.nbytes -= images.nbytes
            images.mask, images.mask_of = upload(mask, self._device), mask
            self.nbytes += images.nbytes
            self._make_room()
        return images.mask

    def _upload(self, image: np.ndarray) -> torch.Tensor:
        return upload(image, self._device)

    def _no_depth(self, color: torch.Tensor) -> torch.Tensor:
        """uint16 [H, W] of zeros, one for all images of the size of `color`."""
        size = (color.shape[0], color.shape[1])
        if size not in self._nothing:
            self._nothing[size] = torch.zeros(size, dtype=torch.int16, device=self._device).view(torch.uint16)
        return self._nothing[size]

    def _make_room(self) -> None:
        while self.nbytes > self._limit and len(self._images) > 1:
            _, images = self._images.popitem(last=False)
            self.nbytes -= images.nbytes
