# SPDX-License-Identifier: Apache-2.0
"""Images of frames on their way to the device, through page-locked memory that is made once."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ggslam.abi.arrays import address
from ggslam.cuda.transfers import Marker
from ggslam.native.loader import load_library

_TYPES: dict[Any, torch.dtype] = {np.float32: torch.float32, np.uint8: torch.uint8}


class FrameUpload:
    """The place of an image on the device, frame after frame.

    Args:
        shape: of the images.
        dtype: of their numbers: float32, depth in metres, or uint8.
        device: where to.
    """

    def __init__(self, shape: tuple[int, ...], dtype: type[np.generic], device: torch.device) -> None:
        self._staged = torch.empty(shape, dtype=_TYPES[dtype], pin_memory=device.type == "cuda")
        self.staged = self._staged.numpy()
        """The image that was sent last, on the host."""
        self.known = 0
        """Pixels of it with depth."""
        self._is_depth, self._staged_address = dtype is np.float32, self._staged.data_ptr()
        self._memory = torch.empty(shape, dtype=_TYPES[dtype], device=device)
        self.address = self._memory.data_ptr()
        """On the device."""
        self._sent = Marker(device)
        self.under_way = False
        """Whether the last image may still be. Who has waited for the stream that it was sent on says that it is not.
        """
        self.image: np.ndarray | None = None
        """The very array that was sent last."""

    def send(self, image: np.ndarray) -> None:
        """Starts to send an image. The host waits for the last one if that is `under_way`."""
        if self.under_way:
            self._sent.set()
            self._sent.wait_if_ahead()
        if self._is_depth and image.dtype == np.float32 and image.flags.c_contiguous:
            self.known = load_library().ggslam_copy_depth(address(image), image.size, self._staged_address)
        else:
            self.staged[...] = image
            self.known = int(np.count_nonzero(self.staged > 0)) if self._is_depth else 0
        self._memory.copy_(self._staged, non_blocking=True)
        self.under_way, self.image = True, image

    def have(self, image: np.ndarray) -> None:
        """The same, unless this very array was sent last."""
        if self.image is not image:
            self.send(image)
