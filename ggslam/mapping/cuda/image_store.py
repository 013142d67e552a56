# SPDX-License-Identifier: Apache-2.0
"""Images of keyframes, and of frames between them, on a device."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import torch

from ggslam.cuda.memory import Slots
from ggslam.cuda.transfers import Staging
from ggslam.mapping.pixel_grid import ALL_PIXELS, PixelGrid
from ggslam.system.tuning import Tuning


class DeviceImageTuning(Tuning):
    """Images of keyframes on a GPU."""

    max_bytes = 512_000_000
    """Most bytes of images kept on the device. The least recently used ones are dropped and uploaded again."""


class ImageSource(Protocol):
    """A keyframe as the store sees it, see `DeviceKeyframe`."""

    mask: np.ndarray | None

    @property
    def color(self) -> np.ndarray: ...

    @property
    def depth(self) -> np.ndarray: ...

    @property
    def image_key(self) -> Hashable: ...

    @property
    def has_depth(self) -> bool: ...


@dataclass(eq=False)
class CudaKeyframeImages:
    """Images of a keyframe.

    Attributes:
        key: what they are kept by.
        color: uint8 [H, W, 3].
        depth: uint16 [H, W], see `Keyframe`.
        depth_of: the array that it was uploaded from; None: one that does not change.
        mask: uint16 [H, W], uploaded when first asked for.
        mask_of: the array that it was uploaded from.
        is_kept: whether they are in the store; if not, their memory is others' by now.
    """

    key: Hashable
    color: torch.Tensor
    depth: torch.Tensor
    depth_of: np.ndarray | None = None
    mask: torch.Tensor | None = None
    mask_of: np.ndarray | None = None
    is_kept: bool = True

    @property
    def nbytes(self) -> int:
        """Memory that they take."""
        return self.color.nbytes + self.depth.nbytes + (0 if self.mask is None else self.mask.nbytes)


_TYPES: Final = {np.dtype(np.uint8): torch.uint8, np.dtype(np.uint16): torch.uint16}


class ImageStore:
    """Images on a device, no more than there is room for.

    Args:
        device: where.
        limit: bytes.
        is_awaited: whether work that reads images was gathered and not started: until it is, the memory of images
            that are dropped is not used again.
    """

    def __init__(
        self, device: torch.device, limit: int = DeviceImageTuning.max_bytes,
        is_awaited: Callable[[], bool] = lambda: False,
    ) -> None:  # fmt: skip
        self._device, self._limit, self._is_awaited = device, limit, is_awaited
        self._images: OrderedDict[Hashable, CudaKeyframeImages] = OrderedDict()
        self._nothing: dict[tuple[int, ...], torch.Tensor] = {}  # depth of frames without any, by size
        self._memory: dict[tuple[object, ...], tuple[Slots, Staging]] = {}  # by shape and type
        self._leaving: list[torch.Tensor] = []
        self.nbytes = 0
        """Memory that they take at present."""

    def of(self, keyframe: ImageSource, grid: PixelGrid = ALL_PIXELS) -> CudaKeyframeImages:
        """Those of a keyframe at a grid's pixels, uploaded if need be."""
        key = keyframe.image_key if grid.is_whole else (keyframe.image_key, grid)
        images, depth_now = self._images.get(key), vars(keyframe).get("depth")  # one in an archive never changes
        if images is None:
            images = self._images[key] = self._new(key, keyframe, grid)
            images.depth_of = depth_now
            self.nbytes += images.nbytes
            self._make_room()
            return images
        if depth_now is not None and images.depth_of is not depth_now:
            self._drop(images.depth)
            images.depth, images.depth_of = self._upload(grid.depth_of(depth_now)), depth_now
        self._images.move_to_end(key)
        return images

    def use(self, images: Iterable[CudaKeyframeImages]) -> None:
        """Of all images that are kept these were used last."""
        for used in images:
            if used.is_kept:
                self._images.move_to_end(used.key)

    def mask_of(
        self, keyframe: ImageSource, grid: PixelGrid = ALL_PIXELS, images: CudaKeyframeImages | None = None
    ) -> torch.Tensor | None:
        """The mask that a keyframe has now, at a grid's pixels. `images`: those of the keyframe there, if they are at
        hand and kept."""
        mask = keyframe.mask
        if mask is None:
            return None
        images = images or self.of(keyframe, grid)
        if images.mask is None or images.mask_of is not mask:
            if images.mask is not None:
                self._drop(images.mask)
                self.nbytes -= images.mask.nbytes
            images.mask, images.mask_of = self._upload(grid.of(mask)), mask
            self.nbytes += images.mask.nbytes
            self._make_room()
        return images.mask

    def _new(self, key: Hashable, keyframe: ImageSource, grid: PixelGrid) -> CudaKeyframeImages:
        color = self._upload(grid.color_of(keyframe.color))
        depth = self._no_depth(color) if not keyframe.has_depth else self._upload(grid.depth_of(keyframe.depth))
        return CudaKeyframeImages(key, color, depth)

    # --- memory ------------------------------------------------------------------------------------------------------

    def _upload(self, image: np.ndarray) -> torch.Tensor:
        slots, staging = self._memory_for(image.shape, _TYPES[image.dtype])
        if self._leaving and not self._is_awaited():
            for left in self._leaving:
                self._memory_for(tuple(left.shape), left.dtype)[0].give_back(left)
            self._leaving = []
        slot = slots.take()
        staging.send(image, slot)
        return slot

    def _memory_for(self, shape: tuple[int, ...], dtype: torch.dtype) -> tuple[Slots, Staging]:
        key = (shape, dtype)
        if key not in self._memory:
            self._memory[key] = Slots(shape, dtype, self._device), Staging(shape, dtype, self._device)
        return self._memory[key]

    def _no_depth(self, color: torch.Tensor) -> torch.Tensor:
        """uint16 [H, W] of zeros, one for all images of the size of `color`."""
        size = (color.shape[0], color.shape[1])
        if size not in self._nothing:
            self._nothing[size] = torch.zeros(size, dtype=torch.int16, device=self._device).view(torch.uint16)
        return self._nothing[size]

    def _drop(self, image: torch.Tensor) -> None:
        if image is not self._nothing.get(tuple(image.shape)):
            self._leaving.append(image)

    def _make_room(self) -> None:
        while self.nbytes > self._limit and len(self._images) > 1:
            _, images = self._images.popitem(last=False)
            self.nbytes -= images.nbytes
            images.is_kept = False
            for image in (images.color, images.depth, images.mask):
                if image is not None:
                    self._drop(image)
