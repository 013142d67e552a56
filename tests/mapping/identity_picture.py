# SPDX-License-Identifier: Apache-2.0
"""A small mask and its keyframe, for tests of identity learning on a device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

HEIGHT, WIDTH = 16, 24


def picture() -> np.ndarray:
    mask = np.ones((HEIGHT, WIDTH), np.uint16)
    mask[3:12, 2:12] = 2
    mask[5:8, 15:20] = 300
    mask[:, 22:] = 0
    return mask


@dataclass
class MaskedKeyframe:
    index: int
    mask: np.ndarray | None
    device: torch.device

    def __post_init__(self) -> None:
        self.device_mask = None if self.mask is None else torch.from_numpy(self.mask).to(self.device)
