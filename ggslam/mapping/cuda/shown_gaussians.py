# SPDX-License-Identifier: Apache-2.0
"""Which Gaussians a rendering on a device shows."""

from __future__ import annotations

import torch

from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.system.tuning import Tuning


class ShownGaussianTuning(Tuning):
    """Looks at what a rendering is made of."""

    terms_at_once = 1 << 21
    """Contributions to pixels for which there is room at once, 8 bytes each."""


def mark_shown(rasterizer: CudaRasterizer, pixels: int, shown: torch.Tensor, least: float) -> None:
    """Marks the Gaussians that the last rendering shows, as `CpuRasterizer.mark_shown`; nothing waits for the device.

    Args:
        rasterizer: that rendered.
        pixels: of its image.
        shown: bool [N] on the device, one for each Gaussian; becomes True for those that have the weight `least`, above
            0, in any pixel.
    """
    capacity = int(1 / least) + 1  # weights of a pixel add up to 1 at most
    at_once = max(1, int(ShownGaussianTuning.terms_at_once) // capacity)
    found = torch.zeros(len(shown), dtype=torch.int32, device=shown.device)
    for begin in range(0, pixels, at_once):
        part = torch.arange(begin, min(begin + at_once, pixels), dtype=torch.int32, device=shown.device)
        terms = rasterizer.pixel_terms(part, capacity, least)
        found.index_add_(0, terms.gaussians.view(-1).long(), (terms.weights.view(-1) > 0).int())
    shown.logical_or_(found > 0)
