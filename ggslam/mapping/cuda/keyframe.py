# SPDX-License-Identifier: Apache-2.0
"""Keyframes whose poses, exposures and images are on a device."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
import torch

from ggslam.cuda.transfers import upload
from ggslam.mapping.cuda.keyframe_states import KeyframeStates
from ggslam.mapping.keyframe import Keyframe
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
        mask: uint16 [H, W], uploaded when first asked for.
        mask_of: the array that it was uploaded from.
        shown: bool [H, W], where colours count, uploaded when first asked for; None: everywhere.
        shown_of: what it was made from.
    """

    color: torch.Tensor
    depth: torch.Tensor
    mask: torch.Tensor | None = None
    mask_of: np.ndarray | None = None
    shown: torch.Tensor | None = None
    shown_of: tuple[np.ndarray | None, np.ndarray | None] = (None, None)

    @property
    def nbytes(self) -> int:
        """Memory that they take."""
        return sum(image.nbytes for image in (self.color, self.depth, self.mask, self.shown) if image is not None)


class CudaKeyframe(Keyframe):
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
        """Only the beginning sets it, and that goes with the row."""

    @property
    def device_images(self) -> CudaKeyframeImages:
        """On the device."""
        return self._images.of(self)

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
        self._images: OrderedDict[int, CudaKeyframeImages] = OrderedDict()
        self.nbytes = 0
        """Memory that they take at present."""

    def of(self, keyframe: Keyframe) -> CudaKeyframeImages:
        """Those of a keyframe, uploaded if need be."""
        images = self._images.pop(keyframe.index, None)
        if images is None:
            images = CudaKeyframeImages(upload(keyframe.color, self._device), upload(keyframe.depth, self._device))
            self.nbytes += images.nbytes
        self._images[keyframe.index] = images  # the one used last stands last
        if self.nbytes > self._limit:
            self._make_room()
        return images

    def mask_of(self, keyframe: Keyframe) -> torch.Tensor | None:
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

    def usable_of(
        self, keyframe: Keyframe, valid: np.ndarray | None, find: Callable[[Keyframe], np.ndarray | None]
    ) -> torch.Tensor | None:
        """Where a keyframe's colours count, bool [H, W]; None: everywhere.

        Args:
            valid: where images of its camera show something; None: everywhere.
            find: tells it on the host; asked only if `valid` or what moved is another one than the last time.
        """
        moving = keyframe.moving
        if valid is None and moving is None:
            return None
        images = self.of(keyframe)
        if images.shown_of[0] is not valid or images.shown_of[1] is not moving:
            self.nbytes -= images.nbytes
            shown = find(keyframe)
            images.shown = None if shown is None else upload(shown, self._device)
            images.shown_of = (valid, moving)
            self.nbytes += images.nbytes
            self._make_room()
        return images.shown

    def _make_room(self) -> None:
        while self.nbytes > self._limit and len(self._images) > 1:
            _, images = self._images.popitem(last=False)
            self.nbytes -= images.nbytes
