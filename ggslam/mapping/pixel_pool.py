# SPDX-License-Identifier: Apache-2.0
"""Pixels of a keyframe's mask that are drawn ahead for identity steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
import torch

from ggslam.errors import FormatError
from ggslam.system.array_forms import Form
from ggslam.system.savable import savable

Array = TypeVar("Array", np.ndarray, torch.Tensor)


@savable(save="state")
@dataclass
class PixelPool(Generic[Array]):
    """Pixels of one keyframe drawn for steps to come; arrays on the host or tensors on a device.

    Attributes:
        pixels: int32 [M], flat indices.
        vote_weights: float32 [M], inverse of the density with which each was drawn, mean 1.
        used: how many of them are used up.
    """

    pixels: Array
    vote_weights: Array
    used: int = 0

    def check(self, pixels: int) -> None:
        """Raises FormatError if these are not pixels of an image with so many: they may come from a file."""
        lengths: dict[str, int] = {}
        forms = (Form("i4", "n", below=pixels), Form("f4", "n", finite=True))
        for array, form in zip((self.pixels, self.vote_weights), forms, strict=True):
            if found := form.check(np.asarray(array), lengths):
                raise FormatError(f"pixels drawn ahead: {found}")
        if not 0 <= self.used <= len(self.pixels):
            raise FormatError(f"pixels drawn ahead: {self.used} of {len(self.pixels)} are used")

    def state(self) -> dict[str, Any]:
        """What is saved: the pixels that are left."""
        return {"pixels": self.pixels[self.used :], "vote_weights": self.vote_weights[self.used :], "used": 0}

    def has(self, count: int) -> bool:
        """Whether so many pixels are left."""
        return self.used + count <= len(self.pixels)

    def take(self, count: int) -> tuple[Array, Array]:
        """The next `count` pixels (fewer if no more are left) and their weights."""
        part = slice(self.used, self.used + count)
        self.used = part.stop
        return self.pixels[part], self.vote_weights[part]
