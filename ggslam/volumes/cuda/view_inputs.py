# SPDX-License-Identifier: Apache-2.0
"""The images of views on their way to a device, and there until the views are fused for certain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from ggslam.cuda.memory import GrowingMemory
from ggslam.cuda.transfers import Upload
from ggslam.volumes.fusion_view import FusionView


@dataclass(frozen=True)
class SentImages:
    """Addresses of images on the device; 0: none."""

    depth: int
    color: int
    labels: int


class ViewImages:
    """The images of one view.

    Args:
        device: where to.
    """

    def __init__(self, device: torch.device) -> None:
        self._upload, self._memory = Upload(device), GrowingMemory(device)
        self.depth: np.ndarray = np.empty((0, 0), np.float32)
        """The depth that was sent last, metres [H, W]; of memory that is used again."""

    def send(self, view: FusionView) -> SentImages:
        """Starts to copy depth, colour and labels, in one copy."""
        parts = [part for part in (view.depth, view.labels, view.color) if part is not None]
        begins = np.cumsum([0, *((part.nbytes + 15) // 16 * 16 for part in parts)]).tolist()
        staged = self._upload.begin(begins[-1])
        for part, begin in zip(parts, begins[:-1], strict=True):
            staged[begin : begin + part.nbytes] = part.reshape(-1).view(np.uint8)
        self.depth = staged[: view.depth.nbytes].view(np.float32).reshape(view.depth.shape)
        block = self._memory.block("images", begins[-1])
        self._upload.send(block[: begins[-1]])
        places = dict(zip(map(id, parts), (block.data_ptr() + begin for begin in begins), strict=False))
        return SentImages(*(places.get(id(part), 0) for part in (view.depth, view.color, view.labels)))
