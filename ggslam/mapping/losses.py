# SPDX-License-Identifier: Apache-2.0
"""The loss between a rendered view and a keyframe: its inputs and outputs on any device.

    loss = (1 - dssim_weight) mean rho(x - y) + dssim_weight (1 - mean SSIM(x, y))
           + depth_weight mean_valid |D - D_target| + opacity_weight mean_valid (1 - alpha)

x is the rendered colour after the keyframe's exposure (gain * rendered + offset, per channel), y the target in [0, 1];
rho is |.| or Charbonnier; SSIM (Wang et al. 2004) has an 11x11 Gaussian window, sigma 1.5, and zero padding. At pixels
without depth x is first pulled to the target, x <- w x + (1 - w) y with w = `no_depth_weight`. `mean_valid` is over
the pixels whose target depth is known. `tests/mapping/losses_reference.py` says the same in a page of torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
import torch

Array = TypeVar("Array", np.ndarray, torch.Tensor)
LOSS_WEIGHTS = (
    "dssim_weight", "depth_weight", "opacity_weight", "no_depth_weight", "minimum_alpha", "charbonnier_epsilon"
)  # fmt: skip
"""Numbers of `LossSettings`, in the order in which the compiled core and the kernels take them."""


class RenderedImages(Protocol):
    """Images from a renderer; float32 on the device of the loss, contiguous."""

    @property
    def image(self) -> torch.Tensor:
        """Colour [3, H, W]."""

    @property
    def depth(self) -> torch.Tensor:
        """Accumulated (not normalised) depth [H, W], metres."""

    @property
    def alpha(self) -> torch.Tensor:
        """Opacity [H, W]."""


@dataclass(frozen=True)
class LossTarget(Generic[Array]):
    """The images of a keyframe that a rendered view is compared with; arrays on the host or tensors on a device.

    Attributes:
        color: uint8 [H, W, 3].
        depth: uint16 or float32 [H, W]; 0, negative, infinite or NaN: none.
        depth_scale: metres per unit of `depth`.
        exposure: float [3, 2] (float32 on a device), gain and offset applied to the rendered R, G, B; None: (1, 0).
        valid: bool [H, W], False where `color` shows nothing, which counts for nothing; None: all of it counts.
    """

    color: Array
    depth: Array
    depth_scale: float
    exposure: Array | None = None
    valid: Array | None = None


@dataclass(frozen=True)
class LossValues:
    """Values of the terms, unweighted unless said otherwise; NaN where nothing was measured.

    Attributes:
        total: the loss.
        color: mean rho(x - y).
        l1: mean |x - y|.
        ssim: mean SSIM; NaN when `dssim_weight` is 0.
        depth: depth term (its mean is over all valid pixels; 0 if there is none).
        opacity: opacity term, likewise.
        depth_l1_m: mean depth error over the pixels that count in the depth term, metres.
        psnr: over pixels with depth, of the exposed image clipped to [0, 1], dB.
        valid_pixels: number of pixels with depth.
    """

    total: float
    color: float
    l1: float
    ssim: float
    depth: float
    opacity: float
    depth_l1_m: float
    psnr: float
    valid_pixels: int


@dataclass(frozen=True)
class LossGradients:
    """Gradients of the loss for the rasterizer's backward pass, on the device of the loss.

    Attributes:
        d_image: d loss / d rendered image (before exposure), float32 [3, H, W].
        d_depth: d loss / d accumulated depth, float32 [H, W].
        d_alpha: d loss / d alpha, float32 [H, W].
    """

    d_image: torch.Tensor
    d_depth: torch.Tensor
    d_alpha: torch.Tensor
