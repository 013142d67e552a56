# SPDX-License-Identifier: Apache-2.0
"""Where the colours of keyframes count, on a device."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable

import numpy as np
import torch

from ggslam.cuda.transfers import upload
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe
from ggslam.mapping.pixel_grid import ALL_PIXELS, PixelGrid
from ggslam.system.tuning import Tuning

_Sources = tuple[np.ndarray | None, ...]


class UsablePixelTuning(Tuning):
    """Masks of pixels on a GPU."""

    kept = 256
    """Most masks kept on the device. The least recently used ones are dropped and uploaded again."""


class UsablePixels:
    """Masks bool [H, W] on a device, uploaded once.

    Args:
        device: where.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._kept: OrderedDict[Hashable, tuple[_Sources, torch.Tensor | None]] = OrderedDict()
        self.kept_since = object()
        """Another object as soon as a mask is dropped: who holds masks longer would keep them all in memory."""

    def valid(
        self, keyframe: Keyframe, sources: _Sources, make: Callable[[], np.ndarray | None],
        grid: PixelGrid = ALL_PIXELS,
    ) -> torch.Tensor | None:  # fmt: skip
        """Where a keyframe shows something of the map; None: everywhere.

        Args:
            keyframe: whose.
            sources: arrays that the mask is made from: while they are the same, it is.
            make: gives the mask, bool [H, W]; None: everywhere.
            grid: whose pixels.
        """
        if not [source for source in sources if source is not None]:
            return None
        whose: Hashable = keyframe.index
        if keyframe.moving is None:
            whose = keyframe.camera_number, keyframe.camera, keyframe.frame_index == FROM_EARLIER_RUN
        return self._keep(("valid", whose, grid), sources, make, grid)

    def nowhere(self, keyframe: Keyframe, grid: PixelGrid = ALL_PIXELS) -> torch.Tensor | None:
        """No pixel."""
        shape = (keyframe.camera.height, keyframe.camera.width)
        return self._keep(("nowhere", shape, grid), (), lambda: np.zeros(shape, bool), grid)

    def _keep(
        self, key: Hashable, sources: _Sources, make: Callable[[], np.ndarray | None], grid: PixelGrid
    ) -> torch.Tensor | None:
        found = self._kept.pop(key, None)
        if found is None or any(a is not b for a, b in zip(found[0], sources, strict=True)):
            mask = make()
            found = (sources, None if mask is None else upload(grid.valid_of(mask), self._device))
        self._kept[key] = found  # the one used last stands last
        if len(self._kept) > UsablePixelTuning.kept:
            self._kept.popitem(last=False)
            self.kept_since = object()
        return found[1]
