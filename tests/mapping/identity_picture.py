# SPDX-License-Identifier: Apache-2.0
"""A small mask, its keyframe and a map, for tests of identity learning on a device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from ggslam.scene.gaussian_map import GaussianMap

HEIGHT, WIDTH = 16, 24
COUNT = 300


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


def make_map(device: torch.device | str, count: int = COUNT) -> GaussianMap:
    """Gaussians that only have means and room for identity vectors."""
    gaussians = GaussianMap(0, 16, torch.device(device))
    means = torch.from_numpy(np.random.default_rng(3).normal(size=(count, 3)).astype(np.float32)).to(device)
    other = [torch.zeros(count, *shape, device=device) for shape in ((4,), (3,), (), (3,))]
    gaussians.insert(means, *other)
    return gaussians
