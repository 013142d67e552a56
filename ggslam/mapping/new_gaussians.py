# SPDX-License-Identifier: Apache-2.0
"""Gaussians that a keyframe brings, before they are in the map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
import torch

Array = TypeVar("Array", np.ndarray, torch.Tensor)


@dataclass(frozen=True)
class NewGaussians(Generic[Array]):
    """Gaussians to insert, world frame, float32; arrays on the host or tensors on a device.

    Attributes:
        means: [M, 3], metres.
        quaternions: [M, 4] wxyz, of unit length.
        log_scales: [M, 3], natural logarithm of the standard deviations in metres.
        rgb: [M, 3] in [0, 1].
        pixels: int64 [M], on a device int32, flat index of the pixel that each comes from.
    """

    means: Array
    quaternions: Array
    log_scales: Array
    rgb: Array
    pixels: Array

    def __len__(self) -> int:
        return len(self.means)
