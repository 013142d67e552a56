# SPDX-License-Identifier: Apache-2.0
"""Pixels of a keyframe's mask that are drawn ahead for identity steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
import torch

Array = TypeVar("Array", np.ndarray, torch.Tensor)


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

    def has(self, count: int) -> bool:
        """Whether so many pixels are left."""
        return self.used + count <= len(self.pixels)

    def take(self, count: int) -> tuple[Array, Array]:
        """The next `count` pixels (fewer if no more are left) and their weights."""
        part = slice(self.used, self.used + count)
        self.used = part.stop
        return self.pixels[part], self.vote_weights[part]
