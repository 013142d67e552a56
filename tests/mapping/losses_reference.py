# SPDX-License-Identifier: Apache-2.0
"""The loss of `losses.py` written down plainly in torch, differentiable by autograd. For tests and comparisons."""

from __future__ import annotations

import torch

from ggslam.mapping.losses import LossTarget
from ggslam.mapping.settings import LossSettings
from ggslam.rendering.losses import ssim_map


def reference_loss(
    image: torch.Tensor, depth: torch.Tensor, alpha: torch.Tensor, exposure: torch.Tensor, target: LossTarget,
    settings: LossSettings,
) -> dict[str, torch.Tensor]:  # fmt: skip
    """The values of `LossValues` by name, as scalars that carry their graph. Computes in the type of `image`.

    Args:
        image: rendered colour [3, H, W]; float64 for tests.
        depth: accumulated depth [H, W], metres.
        alpha: [H, W].
        exposure: [3, 2]; stands in for `target.exposure`.
    """
    y = torch.tensor(target.color).permute(2, 0, 1).to(image.dtype) / 255
    target_depth = torch.from_numpy(target.depth.astype("float64")).to(image.dtype) * target.depth_scale
    valid = torch.isfinite(target_depth) & (target_depth > 0)

    exposed = exposure[:, 0, None, None] * image + exposure[:, 1, None, None]
    x = torch.where(valid, exposed, settings.no_depth_weight * exposed + (1 - settings.no_depth_weight) * y)
    if target.valid is not None:
        x = torch.where(torch.from_numpy(target.valid), x, y)
    l1 = (x - y).abs().mean()
    color = l1
    if settings.color_kind == "charbonnier":
        epsilon = settings.charbonnier_epsilon
        color = (torch.sqrt((x - y) ** 2 + epsilon**2) - epsilon).mean()
    similarity = ssim_map(x, y).mean()

    used = valid
    if settings.depth_kind == "normalised":
        used = valid & (alpha >= settings.minimum_alpha)
        depth = depth / torch.where(used, alpha, 1.0)
    error = (depth - target_depth)[used].abs().sum()
    count = valid.sum().clamp(min=1)
    depth_term, opacity_term = error / count, (1 - alpha)[valid].sum() / count
    total = (1 - settings.dssim_weight) * color + settings.dssim_weight * (1 - similarity)
    total = total + settings.depth_weight * depth_term + settings.opacity_weight * opacity_term
    return {
        "total": total, "color": color, "l1": l1, "ssim": similarity, "depth": depth_term, "opacity": opacity_term,
        "depth_l1_m": error / used.sum(), "psnr": -10 * ((exposed.clamp(0, 1) - y)[:, valid] ** 2).mean().log10(),
    }  # fmt: skip
